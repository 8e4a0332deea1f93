"""The nightly gate over real audits: simulated faults are caught, photos reconstructed again stay green."""

import contextlib
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

NOISE = NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=0.5, log_spread=0.75)
SCENE = SceneSpec(num_images=20, points_per_image=250, noise=NOISE)
LEARN, CHECK = 3, 5


def audit(folder: Path, run: Path) -> None:
    assert main(["run", str(folder), "-o", str(run), "--jobs", "1", "--quiet"]) == 0


def simulated_run(folder: Path, spec: SceneSpec = SCENE, seed: int = 1) -> Path:
    """Audit two scenes of the same geometry each time; what differs is the spec."""
    for i, name in enumerate(("a", "b")):
        scene = simulate_scene(spec if name == "a" else SCENE, np.random.default_rng([seed, i]))
        write_adjusted_model(scene, folder / "photos" / name / "sparse/0")
    audit(folder / "photos", folder / "RUN")
    return folder / "RUN"


@pytest.fixture(scope="module")
def baseline(tmp_path_factory):
    return simulated_run(tmp_path_factory.mktemp("baseline"))


@pytest.fixture
def again(baseline, tmp_path):
    """A copy of the photos of the baseline, to be damaged and audited again."""
    return Path(shutil.copytree(baseline.parent / "photos", tmp_path / "photos"))


def failed(run: Path, baseline: Path, capsys) -> str:
    gate = run.parent / "gate.toml"
    gate.touch()
    code = main(["check", str(run), "--policy-file", str(gate), "--baseline", str(baseline)])
    out = capsys.readouterr().out
    assert code == int("FAILED" in out)
    return out


def test_the_same_model_passes(again, baseline, capsys):
    audit(again, again.parent / "RUN")
    assert failed(again.parent / "RUN", baseline, capsys).startswith("PASSED")


def test_a_lost_scene_is_caught(again, baseline, capsys):
    shutil.rmtree(again / "b")
    audit(again, again.parent / "RUN")
    assert "band.lost_scenes" in failed(again.parent / "RUN", baseline, capsys)


def test_five_percent_of_images_lost_are_caught(again, baseline, capsys):
    model = pycolmap.Reconstruction(str(again / "a/sparse/0"))
    model.deregister_frame(model.images[3].frame_id)
    model.write(str(again / "a/sparse/0"))
    audit(again, again.parent / "RUN")
    assert "band.lost_images: 1 of 20 images" in failed(again.parent / "RUN", baseline, capsys)


def test_another_camera_model_is_caught(again, baseline, capsys):
    model = pycolmap.Reconstruction(str(again / "a/sparse/0"))
    camera = model.images[3].camera
    f, cx, cy, k1 = camera.params
    camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [f, f, cx, cy, k1, 0, 0, 0]
    model.write(str(again / "a/sparse/0"))
    audit(again, again.parent / "RUN")
    out = failed(again.parent / "RUN", baseline, capsys)
    assert "band.camera_model_changed" in out
    assert "SIMPLE_RADIAL -> OPENCV" in out


def test_thirty_percent_more_noise_is_caught(tmp_path, baseline, capsys):
    run = simulated_run(tmp_path, replace(SCENE, noise=replace(NOISE, sigma_px=0.65)))
    assert "band.median_sigma" in failed(run, baseline, capsys)


@pytest.mark.parametrize("kind", [DefectKind.RADIAL_K2, DefectKind.PERTURBED_POSE])
def test_a_new_systematic_error_of_six_tenths_of_a_pixel_is_caught(tmp_path, baseline, kind, capsys):
    run = simulated_run(tmp_path, replace(SCENE, defects=(DefectSpec(3, kind, 0.6),)))
    assert "band.systematic_px" in failed(run, baseline, capsys)


def matched_database(source: Path, database: Path, rng: np.random.Generator) -> None:
    """Copy the keypoints of ten photos and add matches: those of the tracks, and one wrong one to four right."""
    shutil.copyfile(source / "database.db", database)
    database.chmod(0o644)
    model = pycolmap.Reconstruction(str(source / "sparse/manhattan/0"))
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for point in model.points3D.values():
        ends = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for (i, a), (j, b) in combinations(ends, 2):
            if i < j:
                pairs.setdefault((i, j), []).append((a, b))
    with contextlib.closing(pycolmap.Database.open(database)) as opened:
        for (i, j), right in pairs.items():
            num_wrong = len(right) // 4
            num_keypoints = [len(model.images[k].points2D) for k in (i, j)]
            wrong = np.column_stack([rng.integers(0, n, num_wrong) for n in num_keypoints])
            opened.write_matches(i, j, np.vstack([np.array(right), wrong]).astype(np.uint32))


def reconstructed_run(folder: Path, matched: Path, images: Path, seed: int) -> Path:
    (folder / "photos/sparse").mkdir(parents=True)
    database = folder / "database.db"
    shutil.copyfile(matched, database)
    pycolmap.set_random_seed(seed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.geometric_verification(database, two_view_geometry_options=verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.min_model_size = seed, 3
    pycolmap.incremental_mapping(database, images, folder / "photos/sparse", options)
    audit(folder / "photos", folder / "RUN")
    return folder / "RUN"


@pytest.mark.corpus
def test_photos_reconstructed_again_stay_green_once_the_band_is_learnt(corpus, tmp_path):
    """The keypoints are stored, which saves a minute; scripts/study_nightly.py extracts and matches them anew."""
    source = corpus / "megadepth_like/MegaDepth_v1_SfM/9001"
    if not (source / "images").is_dir():
        pytest.skip(f"no photos at {source}")
    matched = tmp_path / "database.db"
    matched_database(source, matched, np.random.default_rng(0))
    runs = [
        str(reconstructed_run(tmp_path / f"{seed}", matched, source / "images", seed)) for seed in range(LEARN + CHECK)
    ]
    gate = str(tmp_path / "gate.toml")
    assert main(["learn-band", *runs[:LEARN], "-o", gate]) == 0
    for run in runs[LEARN:]:
        assert main(["check", run, "--policy-file", gate, "--baseline", runs[0]]) == 0
    assert main(["diff", runs[0], runs[-1], "--exit-code"]) == 1, "other seeds, other reconstructions"
