"""One list of formats: what is added to it is found, counted, read, audited, resumed and listed."""

import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from model_writer import noisy_model, tiny_model, write_binary, write_text
from toy_format import FILE, TOY

from sfm_audit.audit.cli.main import main
from sfm_audit.loaders import FindingCode, LoadError, MissingFileError, discover, formats, open_model
from sfm_audit.loaders.datasets.image_counts import count_images
from sfm_audit.loaders.datasets.input_state import input_stamp, read_input_state
from sfm_audit.reports.export.pruned_model import plan_pruning, write_pruned

LOADERS = Path(formats.__file__).parent
ROOT = LOADERS.resolve().parent


@pytest.fixture
def toy(monkeypatch) -> None:
    """The list entry; the one file is toy_format.py."""
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, TOY))


def write_toy(folder: Path, model) -> Path:
    lines = []
    for camera in model.cameras:
        params = camera.params if camera.model_id == 2 else (*camera.params[1:4], camera.params[4])
        lines.append(f"C {camera.camera_id} {camera.width} {camera.height} {' '.join(map(repr, params))}")
    for image in model.images:
        lines.append(f"I {image.image_id} {image.camera_id} {' '.join(map(repr, image.pose))} {image.name}")
        lines += [f"O {image.image_id} {x!r} {y!r} {point}" for x, y, point in image.points2d if point < 2**63]
    lines += [f"P {point.point_id} {' '.join(map(repr, point.xyz))}" for point in model.points]
    folder.mkdir(parents=True)
    (folder / FILE).write_text("\n".join(lines) + "\n")
    return folder


def run(*words: str) -> int:
    return main(list(words))


@pytest.mark.usefixtures("toy")
def test_a_format_is_one_file_and_one_entry(tmp_path: Path, capsys):
    folder = write_toy(tmp_path / "data" / "scene", noisy_model())
    binary = write_binary(tmp_path / "data" / "other", noisy_model())
    found = discover([tmp_path / "data"])
    assert [(ref.scene, ref.num_bytes > 0) for ref in found.refs] == [("other", True), ("scene", True)]
    assert count_images(str(folder)) == 5

    ours, theirs = open_model(folder), open_model(binary)
    assert (ours.file_format, theirs.file_format) == ("toy", "binary")
    assert {finding.code for finding in ours.findings} == {FindingCode.STORED_ERRORS_MISSING}
    assert np.array_equal(ours.observations.xy_px, theirs.observations.xy_px)
    assert np.array_equal(ours.observations.point_idx, theirs.observations.point_idx)

    out = tmp_path / "run"
    assert run("run", str(tmp_path / "data"), "-o", str(out), "--jobs", "1", "--quiet") == 0
    models = pq.read_table(out / "models").to_pandas().set_index("scene")
    assert models.loc["scene", "file_format"] == "toy"
    images = pq.read_table(out / "images").to_pandas()
    sigmas = [images[images.scene == scene].sigma_constant_px.to_numpy() for scene in ("scene", "other")]
    assert np.isfinite(sigmas[0]).all()
    assert len(sigmas[0]) == len(sigmas[1]) == 5

    capsys.readouterr()
    assert run("run", str(tmp_path / "data"), "--list") == 0
    listed = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert [(cells[1], cells[3]) for cells in listed] == [("other", "5"), ("scene", "5")]


@pytest.mark.usefixtures("toy")
def test_a_finished_model_of_a_new_format_is_not_audited_again_until_its_file_changes(tmp_path: Path):
    folder, out = write_toy(tmp_path / "data" / "scene", noisy_model()), tmp_path / "run"
    words = ("run", str(tmp_path / "data"), "-o", str(out), "--jobs", "1", "--quiet")
    assert run(*words) == 0
    before, state = {path: path.stat().st_mtime_ns for path in out.glob("*/part-*")}, read_input_state(str(folder))
    assert before
    assert run(*words) == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/part-*")} == before

    with (folder / FILE).open("a") as file:
        file.write("P 999 0.0 0.0 5.0\n")
    assert input_stamp(str(folder)) != state.stamp
    assert run(*words) == 0
    assert all(path.stat().st_mtime_ns > time for path, time in before.items())


@pytest.mark.usefixtures("toy")
def test_what_a_format_lacks_is_said_in_one_line(tmp_path: Path):
    folder = write_toy(tmp_path / "scene", noisy_model())
    model = open_model(folder)
    with pytest.raises(LoadError, match=r"a model in a format that can be written \(binary, text\), found .* toy"):
        write_pruned(model, plan_pruning(model, {1}), tmp_path)
    with pytest.raises(LoadError, match="sizes of keypoints, found the format toy"):
        formats.keypoint_scales_of(model, str(folder))


@pytest.mark.usefixtures("toy")
def test_the_first_complete_format_of_a_folder_is_read(tmp_path: Path):
    write_toy(tmp_path / "m", noisy_model())
    write_text(tmp_path / "m", tiny_model())
    assert open_model(tmp_path / "m").file_format == "text"
    (tmp_path / "m" / "points3D.txt").unlink()
    assert open_model(tmp_path / "m").file_format == "toy"


def test_without_the_entry_the_file_means_nothing(tmp_path: Path):
    folder = write_toy(tmp_path / "scene", noisy_model())
    assert discover([tmp_path]).refs == ()
    with pytest.raises(MissingFileError):
        open_model(folder)


def test_no_other_module_knows_the_names_of_files():
    """What must not come back: file names of a format outside of its folder."""
    name = re.compile(r"(?:cameras|images|points3D|rigs|frames)(?:\.bin|\.txt)")
    allowed = {"loaders/colmap", "loaders/foreign/kapture.py", "loaders/references", "audit/simulate/colmap_files.py"}
    known = []
    for room in ("loaders", "audit", "reports"):
        for path in (ROOT / room).rglob("*.py"):
            where = str(path.relative_to(ROOT))
            if not any(where.startswith(each) for each in allowed) and name.search(path.read_text(encoding="utf-8")):
                known.append(where)
    assert known == []
