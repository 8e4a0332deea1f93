"""Limits on how well poses are known: in filter, in gates, in explanations."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from gate_samples import but, rejected, scene, write_run

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.reports.compare.comparison import RunSnapshot
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import GatePolicy
from sfm_audit.reports.run_folder.reader import RunReader


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def known(turns, centres=None):
    """A scene whose rotations and centres are known so well; NaN: not known."""
    centres = np.full(len(turns), 0.001) if centres is None else np.array(centres)
    return scene(len(turns), sd_rotation_deg=np.array(turns), sd_centre=centres)


def kept(*options: str) -> list[str]:
    assert main(["filter", "RUN", *options, "--list", "kept.txt", "--force"]) == 0
    return [name.removeprefix("IMG_000").removesuffix(".jpg") for name in Path("kept.txt").read_text().split()]


def test_filter_keeps_poses_that_are_known_so_well():
    write_run(Path("RUN"), {"a": rejected(known([0.05, 0.1, 0.11, np.nan, 0.5], [0.001, 0.02, 0.001, 0.001, 0.01]), 4)})
    assert kept() == ["0", "1", "2", "3"]
    assert kept("--max-rotation-sd", "0.1") == ["0", "1"]
    assert kept("--max-centre-sd", "0.01") == ["0", "2", "3"]
    assert kept("--max-rotation-sd", "0.1", "--max-centre-sd", "0.01") == ["0"]
    removed = Path("kept.txt.removed.csv").read_text()
    assert "sd_centre: 0.02 > 0.01" in removed
    assert "sd_rotation_deg: 0.11 > 0.1" in removed
    assert "sd_rotation_deg: not known" in removed
    assert "ks_rejected: p = 0.01; sd_rotation_deg: 0.5 > 0.1" in removed


def test_filter_says_where_a_run_knows_nothing_of_its_poses(capsys):
    write_run(Path("RUN"), {"a": known([np.nan, np.nan], [np.nan, np.nan])})
    assert main(["filter", "RUN", "--max-rotation-sd", "0.1", "--list", "kept.txt"]) == 2
    assert "holds no sd_rotation_deg; audit the models again with sfm-audit run --covariance" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["0", "-1", "nan", "x"])
def test_a_limit_is_a_number_above_zero(value, capsys):
    write_run(Path("RUN"), {"a": known([0.1])})
    assert main(["filter", "RUN", "--max-centre-sd", value, "--list", "kept.txt"]) == 2
    assert "--max-centre-sd" in capsys.readouterr().err


def checks(columns, limits: str):
    run = RunSnapshot.read(write_run(Path("RUN"), {"a": columns}))
    return judge(GatePolicy.model_validate(tomllib.loads(limits)), run, None)


@pytest.mark.parametrize(
    ("limits", "passes"),
    [
        ("max_sd_rotation_deg = 0.2", True),
        ("max_sd_rotation_deg = 0.19", False),
        ("max_sd_centre = 0.02", True),
        ("max_sd_centre = 0.019", False),
    ],
)
def test_gates_limit_the_worst_of_the_accepted_images(limits, passes):
    columns = rejected(known([0.1, 0.2, 5.0, 0.1], [0.02, 0.01, 3.0, 0.01]), 2)
    for text in (f"[limits]\n{limits}", f'[[scene]]\nmatch = "a"\n[scene.limits]\n{limits}'):
        (check,) = checks(columns, text)
        assert check.passed == passes
        assert check.value == (0.2 if "rotation" in limits else 0.02)
        assert len(check.images) == (0 if passes else 1)
        assert check.name == f"limits.{limits.split(' =')[0]}"


def test_a_gate_fails_on_an_accepted_image_of_which_nothing_is_known():
    (check,) = checks(known([0.1, np.nan]), "limits.max_sd_rotation_deg = 0.2")
    assert not check.passed
    assert [remark for _, remark in check.images] == ["not known"]
    (check,) = checks(but(known([0.1, np.nan]), 1, verdict="undetermined"), "limits.max_sd_rotation_deg = 0.2")
    assert check.passed
    (check,) = checks(known([np.nan, np.nan]), "limits.max_sd_rotation_deg = 0.2")
    assert (check.passed, check.value) == (False, None)
    assert "--covariance" in check.message


def test_run_says_how_well_poses_are_known_where_it_is_asked():
    spec = SceneSpec(num_images=4, points_per_image=60, min_track_length=3, max_track_length=4)
    write_adjusted_model(simulate_scene(spec, np.random.default_rng(0)), Path("MODEL"))
    assert main(["run", "MODEL", "-o", "ASKED", "--covariance", "--quiet", "--jobs", "1"]) == 0
    rows = list(RunReader.open(Path("ASKED")).rows("images", ("sd_rotation_deg", "sd_neighbour")))
    assert all(row["sd_rotation_deg"] > 0 for row in rows)
    assert {row["sd_neighbour"] for row in rows} <= {f"IMG_{k:04d}.jpg" for k in range(1, 5)}
