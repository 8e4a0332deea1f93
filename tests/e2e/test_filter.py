"""sfm-audit filter as a user meets it, on simulated photos with planted defects."""

import csv
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders import open_model

PLANTED = {3: DefectKind.RADIAL_K2, 8: DefectKind.TANGENTIAL, 12: DefectKind.RADIAL_K2, 17: DefectKind.PERTURBED_POSE}
MISFITS = {3, 8, 12}
MODEL = "data/0022/sparse/0"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A data set with planted defects, and its audit."""
    folder = tmp_path_factory.mktemp("simulated")
    defects = tuple(DefectSpec(i, kind, 1.5) for i, kind in PLANTED.items())
    spec = SceneSpec(num_images=24, points_per_image=300, defects=defects)
    write_adjusted_model(simulate_scene(spec, np.random.default_rng(5)), folder / MODEL)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    return folder


@pytest.fixture
def here(simulated, tmp_path, monkeypatch):
    """A copy of it, the working folder's."""
    shutil.copytree(simulated, tmp_path, dirs_exist_ok=True, copy_function=os.link)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_table(run: str) -> pd.DataFrame:
    return pd.read_parquet(f"{run}/images").set_index("image_name")


def prune_and_audit(*options: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    pruned = "pruned/0022/sparse/0"
    assert main(["filter", "RUN", "--model", MODEL, "--model-out", pruned, *options]) == 0
    assert main(["run", "pruned", "-o", "RUN2", "--quiet"]) == 0
    return run_table("RUN"), run_table("RUN2")


@pytest.mark.usefixtures("here")
def test_no_image_with_a_material_misfit_is_left_and_the_others_changed_only_with_their_tracks():
    before, after = prune_and_audit()
    misfits = set(before.index[before["verdict_misfit"] == "rejected"])
    planted = {open_model(MODEL).images.name[i] for i in MISFITS}
    assert planted <= misfits
    assert not misfits & set(after.index)
    assert sorted(after.index) == sorted(before.index[before["verdict"] != "rejected"])
    assert not (after["verdict_misfit"] == "rejected").any(), "what pulled at the others is gone with its tracks"

    # every kept image: same camera and pose, same residual of every observation whose point is still there
    one, two = open_model(MODEL), open_model("pruned/0022/sparse/0")
    old, new = model_residuals(one), model_residuals(two)
    there = np.isin(one.points.point3d_id, two.points.point3d_id)
    num_untouched = 0
    for image_idx, name in enumerate(two.images.name):
        source = one.images.name.index(name)
        rows = np.arange(old.rows(source).start, old.rows(source).stop)
        kept = rows[there[old.point_idx[rows]]]
        np.testing.assert_array_equal(old.residuals_px[:, kept], new.residuals_px[:, new.rows(image_idx)])
        length = np.linalg.norm(old.residuals_px[:, kept], axis=0)
        row = after.loc[name]
        assert row["num_inliers"] == len(kept)
        assert row["rms_px"] == pytest.approx(np.sqrt(np.mean(length**2)), rel=1e-12)
        assert row["max_px"] == pytest.approx(length.max(), rel=1e-12)
        same = ["image_id", "camera_id", "camera_model", "width", "height", "num_points2d", "folds_over"]
        assert row[same].tolist() == before.loc[name, same].tolist()
        assert row["params"].tolist() == before.loc[name, "params"].tolist()
        if len(kept) == len(rows):
            num_untouched += 1
            raw = ["num_inliers", "rms_px", "mean_px", "median_px", "p95_px", "max_px", "coverage", "sigma_constant_px"]
            assert row[raw].tolist() == before.loc[name, raw].tolist(), "no observation lost: raw numbers are the same"
    assert num_untouched < len(two.images), "some did lose observations, or this test shows nothing"


@pytest.mark.usefixtures("here")
def test_keeping_everything_changes_no_number(monkeypatch):
    accept_all(monkeypatch)
    before, after = prune_and_audit()
    labels = ["dataset", "model_path", "scene", "component"]
    pd.testing.assert_frame_equal(before.drop(columns=labels), after.drop(columns=labels))


def accept_all(monkeypatch):
    monkeypatch.setattr("sfm_audit.reports.export.selection.AuditedImage.is_kept", lambda *_: True)


def write_scene_info(path: str, names) -> dict:
    paths = np.empty(len(names) + 1, dtype=object)
    paths[:-1] = [f"Undistorted_SfM/0022/images/{name}" for name in names]
    pairs = [(np.array([i, i + 1]), 0.5, np.zeros(4)) for i in range(len(names) - 1)]
    values = {"image_paths": paths, "depth_paths": paths, "intrinsics": paths, "poses": paths, "pair_infos": pairs}
    Path(path).write_bytes(pickle.dumps(values, 4))
    return values


@pytest.mark.usefixtures("here")
def test_all_outputs_at_once(capsys):
    images = run_table("RUN")
    values = write_scene_info("in.npz", images.index)
    outputs = ["--list", "out/kept.txt", "--model", MODEL, "--model-out", "out/model"]
    assert main(["filter", "RUN", *outputs, "--scene-info", "in.npz", "--scene-info-out", "out/s.npz"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.count("\n") == 3
    kept = images.index[images["verdict"] != "rejected"].tolist()
    assert Path("out/kept.txt").read_text(encoding="utf-8").splitlines() == kept
    reconstruction = pycolmap.Reconstruction("out/model")
    assert sorted(image.name for image in reconstruction.images.values()) == sorted(kept)
    filtered = np.load("out/s.npz", allow_pickle=True)
    wanted = [p[0].tolist() for p in values["pair_infos"] if {images.index[i] for i in p[0]} <= set(kept)]
    assert [pair[0].tolist() for pair in filtered["pair_infos"]] == wanted
    rejected = images.index[images["verdict"] == "rejected"].tolist()
    for name in ("kept.txt", "model", "s.npz"):
        with Path(f"out/{name}.removed.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["image_name"] for row in rows] == rejected
        assert [row["reasons"] for row in rows] == ["; ".join(images.loc[name, "reasons"]) for name in rejected]
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(
        f"{name}{suffix}" for name in ("kept.txt", "model", "s.npz") for suffix in ("", ".removed.csv")
    ), "no temporary file is left"


@pytest.mark.usefixtures("here")
def test_accepted_keeps_less_than_not_rejected():
    for keep in ("not-rejected", "accepted"):
        assert main(["filter", "RUN", "--keep", keep, "--list", f"{keep}.txt"]) == 0
    images = run_table("RUN")
    assert (
        Path("accepted.txt").read_text(encoding="utf-8").split()
        == images.index[images["verdict"] == "accepted"].tolist()
    )


@pytest.mark.usefixtures("here")
def test_nothing_is_overwritten_without_force(capsys):
    args = ["filter", "RUN", "--list", "F", "--model", MODEL, "--model-out", "D"]
    assert main(args) == 0
    capsys.readouterr()
    contents = {path: path.read_bytes() for path in [Path("F"), *Path("D").iterdir()]}
    for path in ("F", "D", "F.removed.csv", "D.removed.csv"):
        assert main(args) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert f"{path}: " in err
        assert "--force" in err
        shutil.move(path, f"moved-{path}")
    for path in ("F", "D", "F.removed.csv", "D.removed.csv"):
        shutil.move(f"moved-{path}", path)
    Path("F").write_text("old", encoding="utf-8")
    assert main([*args, "--force"]) == 0
    assert {path: path.read_bytes() for path in contents} == contents


@pytest.mark.usefixtures("here")
def test_force_does_not_replace_a_folder_of_something_else(capsys):
    Path("photos").mkdir()
    Path("photos/a.jpg").touch()
    for folder in ("photos", "data", "RUN", MODEL, ".", "photos/..", "/"):
        assert main(["filter", "RUN", "--model", MODEL, "--model-out", folder, "--force"]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert Path("photos/a.jpg").exists()
    assert len(list(Path(MODEL).iterdir())) == 3


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "args",
    [
        [],
        ["--model", MODEL],
        ["--model-out", "D"],
        ["--scene-info", "in.npz"],
        ["--list", "F", "--keep", "rejected"],
        ["--list", "F", "--scene-info", "in.npz", "--scene-info-out", "F"],
        ["--list", "D", "--model", MODEL, "--model-out", "D"],
        ["--scene-info", "in.npz", "--scene-info-out", "in.npz", "--force"],
    ],
)
def test_wrong_usage_is_2_and_writes_nothing(args, capsys):
    write_scene_info("in.npz", ["a.jpg"])
    before = sorted(Path().rglob("*"))
    content = Path("in.npz").read_bytes()
    assert main(["filter", "RUN", *args]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert sorted(Path().rglob("*")) == before
    assert Path("in.npz").read_bytes() == content


@pytest.mark.usefixtures("here")
def test_inputs_that_are_none_are_3_and_the_rest_is_written(capsys):
    assert main(["filter", "data", "--list", "F"]) == 3
    assert main(["filter", "nothing", "--list", "F"]) == 3
    assert not Path("F").exists()
    Path("evil.npz").write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")
    capsys.readouterr()
    args = ["--list", "F", "--model", "nothing", "--model-out", "D"]
    assert main(["filter", "RUN", *args, "--scene-info", "evil.npz", "--scene-info-out", "G"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert "os.system" in err
    assert "nothing in it was run" in err
    assert Path("F").exists()
    assert not any(Path(name).exists() for name in ("D", "G", "ran", "G.removed.csv", "D.removed.csv"))


@pytest.mark.usefixtures("here")
def test_what_the_run_does_not_hold_is_2(capsys):
    shutil.copytree(MODEL, "other")
    reconstruction = pycolmap.Reconstruction("other")
    reconstruction.delete_point3D(min(reconstruction.point3D_ids()))
    reconstruction.write("other")
    assert main(["filter", "RUN", "--model", "other", "--model-out", "D"]) == 2
    assert "no audit of other" in capsys.readouterr().err
    write_scene_info("in.npz", ["unknown.jpg", "stranger.jpg"])
    assert main(["filter", "RUN", "--scene-info", "in.npz", "--scene-info-out", "G"]) == 2
    assert "none of the 2 images" in capsys.readouterr().err
    assert not Path("D").exists()
    assert not Path("G").exists()


@pytest.mark.usefixtures("here")
def test_outputs_that_cannot_be_written_are_4(capsys):
    Path("file").touch()
    write_scene_info("in.npz", run_table("RUN").index)
    for args in (
        ["--list", "file/F"],
        ["--model", MODEL, "--model-out", "file/D"],
        ["--scene-info", "in.npz", "--scene-info-out", "/proc/G"],
    ):
        assert main(["filter", "RUN", *args]) == 4
        assert capsys.readouterr().err.count("\n") == 1
