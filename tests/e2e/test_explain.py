"""sfm-audit explain as a user meets it."""

from pathlib import Path

import numpy as np
import pytest
from run_samples import write_models

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.simulate.demo import demo_scene, truth_records
from sfm_audit.audit.simulate.scene import simulate_scene

PNG = b"\x89PNG"


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """The demo's photos, and what was planted in them."""
    folder = tmp_path_factory.mktemp("explain") / "photos" / "sparse" / "0"
    scene = simulate_scene(demo_scene(0), np.random.default_rng([0, 1]))
    write_adjusted_model(scene, folder)
    return folder, truth_records(scene)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_bent_lens_is_told_and_drawn(demo, capsys):
    folder, truth = demo
    worst = max((t for t in truth if t.defect == DefectKind.RADIAL_K2), key=lambda t: t.size_px or 0)
    assert main(["explain", str(folder), worst.image_name, "-o", "story"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.rstrip() == Path("story/story.txt").read_text(encoding="utf-8").rstrip()
    why = " ".join(out.split())
    assert "the lens bends more than k1 can say" in why
    assert "strongest in the corners" in why
    assert "RADIAL would hold it" in why
    assert "What a verdict does not prove" in why
    pictures = sorted(Path("story").glob("*.png"))
    assert [path.name for path in pictures[:2]] == ["01_residual_vectors.png", "02_explained_field.png"]
    assert all(path.read_bytes().startswith(PNG) for path in pictures)
    assert all(path.name in out for path in pictures)


def test_by_id_and_from_the_folder_above(demo):
    folder, _ = demo
    assert main(["explain", str(folder.parents[1]), "id:1", "-o", "story", "--quiet", "--policy", "paper"]) == 0
    assert "(id 1)" in Path("story/story.txt").read_text(encoding="utf-8")
    assert "under the policy paper" in Path("story/story.txt").read_text(encoding="utf-8")


def test_an_image_with_too_few_points(demo):
    folder, truth = demo
    few = next(t for t in truth if t.defect == DefectKind.FEW_POINTS)
    assert main(["explain", str(folder), few.image_name, "-o", "story", "--quiet"]) == 0
    assert "UNDETERMINED" in Path("story/story.txt").read_text(encoding="utf-8")


def test_what_is_refused(demo, capsys):
    folder, _ = demo
    write_models(Path("two"), ("a", "b"))
    Path("mine").mkdir()
    Path("mine/thesis.txt").touch()
    assert main(["explain", "nowhere", "x", "-o", "story"]) == 3
    assert main(["explain", "two", "x", "-o", "story"]) == 2
    assert main(["explain", str(folder), "nobody.jpg", "-o", "story"]) == 2
    assert main(["explain", str(folder), "id:1", "-o", "mine"]) == 2
    assert main(["explain", str(folder), "id:1", "-o", "mine/thesis.txt/story"]) == 4
    assert len(capsys.readouterr().err.splitlines()) == 5
    assert not Path("story").exists()
    assert main(["explain", str(folder), "id:1", "-o", "story", "--quiet"]) == 0
    assert main(["explain", str(folder), "id:2", "-o", "story", "--quiet"]) == 2
    assert main(["explain", str(folder), "id:2", "-o", "story", "--quiet", "--force"]) == 0
    assert "(id 2)" in Path("story/story.txt").read_text(encoding="utf-8")
