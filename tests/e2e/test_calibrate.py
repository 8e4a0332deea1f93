"""sfm-audit calibrate as a user meets it."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from calibrate_doubles import board, true_camera

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.table import CALIBRATION, CALIBRATION_RESIDUALS
from sfm_audit.audit.table.words import is_remark

PNG = b"\x89PNG"
FIGURES = (
    *("residual_vectors", "radial_profile", "misfit_groups", "standardised_histogram", "qq_plot", "scale_comparison"),
    "expected_error",
)


def write_csv(path, columns, names="x,y,X,Y,Z"):
    with Path(path).open("w", encoding="ascii") as file:
        file.write(f"# width=1600 height=1600\n{names}\n")
        np.savetxt(file, np.column_stack(columns), delimiter=",", fmt="%.12g")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    correspondences, _, _ = board(np.random.default_rng(4), extent=0.8)
    write_csv("board.csv", (correspondences.xy_px, correspondences.xyz_world))


def test_the_right_lens_is_told_from_the_wrong_one(capsys):
    assert main(["calibrate", "board.csv", "-o", "out"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert max(map(len, out.splitlines())) <= 80
    assert out.rstrip() == Path("out/summary.txt").read_text(encoding="utf-8").rstrip()
    table = pd.read_parquet("out/calibration.parquet").set_index("model")
    assert list(table.verdict) == ["rejected", "accepted", "accepted"]
    assert (table.misfit_group["D1"], table.distortion["pnprf"]) == ("radial", "division")
    truth = true_camera()
    assert table.fx_px["D3"] == pytest.approx(800.0, abs=4 * table.sd_focal_px["D3"])
    np.testing.assert_allclose(table.loc["D3", ["k1", "k2"]].astype(float), truth.coefficients[:2], atol=2e-3)
    assert 0.027 < table.sd_px["D3"] < 0.033
    pictures = {path.name for path in Path("out").glob("*.png")}
    assert pictures == {f"{m}_{i:02d}_{name}.png" for m in table.index for i, name in enumerate(FIGURES, 1)}
    assert all((Path("out") / name).read_bytes().startswith(PNG) for name in pictures)


def test_files_say_what_they_are_and_are_the_same_again():
    models = ["--models", "D3"]
    assert main(["calibrate", "board.csv", "-o", "one", "--quiet", *models]) == 0
    assert main(["calibrate", "board.csv", "-o", "two", "--quiet", *models]) == 0
    for name, columns in (("calibration", CALIBRATION), ("residuals", CALIBRATION_RESIDUALS)):
        table = pq.read_table(f"one/{name}.parquet")
        assert table.equals(pq.read_table(f"two/{name}.parquet"))
        assert table.schema.names == [column.name for column in columns]
        assert all(field.metadata[b"meaning"] for field in table.schema)
        settings = json.loads(table.schema.metadata[b"sfm_audit"])
        assert (settings["seed"], settings["min_effect"], settings["threshold_px"]) == (0, "0.5sigma", 5.0)
    assert len(pq.read_table("one/residuals.parquet")) == 225


def test_a_photo_is_undistorted():
    """The board's lines, curved in the photo, are straight in the undistorted image: a corner row, found by OpenCV."""
    camera, photo = true_camera(), np.full((1600, 1600), 255, dtype=np.uint8)
    u = np.linspace(-0.9, 0.9, 400)
    line = camera.project(np.column_stack([u, np.full(400, -0.8), np.ones(400)])).xy_px.T - 0.5
    cv2.polylines(photo, [np.round(line).astype(np.int32)], isClosed=False, color=0, thickness=5)
    cv2.imwrite("photo.png", photo)
    assert main(["calibrate", "board.csv", "--models", "D3", "--image", "photo.png", "-o", "out", "--quiet"]) == 0
    straight = cv2.imread("out/D3_undistorted.png", cv2.IMREAD_GRAYSCALE)
    rows, columns = np.nonzero(straight < 100)
    assert columns.max() - columns.min() > 1000
    assert abs(rows.mean() - (800 - 0.8 * 800)) < 2
    assert rows.std() < 3
    assert np.nonzero(photo < 100)[0].std() > 5


def test_what_determines_no_camera_is_undetermined_and_the_others_go_on(capsys):
    """On a line no estimator finds a camera; on a fronto-parallel board some do, without f."""
    correspondences, _, _ = board(np.random.default_rng(0), extent=0.7, tilt_deg=(0.0, 0.0))
    write_csv("front.csv", (correspondences.xy_px, correspondences.xyz_world))
    x = np.linspace(100, 1500, 40)
    write_csv("line.csv", (x, np.full(40, 700.0), x / 1000, np.zeros(40), np.zeros(40)))
    for name, models in (("front", "D3"), ("line", "D1,D3,pnprf,colmap")):
        assert main(["calibrate", f"{name}.csv", "-o", name, "--models", models]) == 0
        table = pd.read_parquet(f"{name}/calibration.parquet")
        assert "accepted" not in set(table.verdict)
        codes = [{reason.split(":")[0] for reason in reasons} for reasons in table.reasons]
        assert all(found & {"degenerate_input", "focal_not_identified"} for found in codes)
    assert table.fx_px.isna().all()
    assert capsys.readouterr().err == ""
    assert is_remark("fronto_parallel", {"verdict_misfit": "accepted"})


def test_neighbours_bring_the_lidar_noise(capsys):
    correspondences, _, _ = board(np.random.default_rng(4), extent=0.8)
    world = correspondences.xyz_world
    pan, tilt = (world + 1e-3 * np.eye(3)[axis] for axis in (0, 1))
    write_csv("scan.csv", (correspondences.xy_px, world, pan, tilt), "x,y,X,Y,Z,Xp,Yp,Zp,Xt,Yt,Zt")
    assert main(["calibrate", "scan.csv", "--models", "D3", "-o", "out"]) == 0
    assert "noise lidar" in capsys.readouterr().out
    assert pd.read_parquet("out/calibration.parquet").noise_model.tolist() == ["lidar"]
    assert main(["calibrate", "scan.csv", "--models", "D3", "--noise", "constant"]) == 0
    assert "noise constant" in capsys.readouterr().out


def test_without_the_extra_one_line_says_so(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "poselib", None)
    for name in [
        name
        for name in sys.modules
        if name.startswith(("sfm_audit.audit.calibrate", "sfm_audit.audit.cli.calibration"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["calibrate", "board.csv"]) == 2
    assert 'poselib is not installed; it belongs to the extra "calibrate"' in capsys.readouterr().err


def test_what_is_refused(capsys):
    Path("mine").mkdir()
    Path("mine/thesis.txt").touch()
    write_csv("nan.csv", ([1.0, np.nan], [1.0, 2.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]))
    cv2.imwrite("small.png", np.zeros((3, 4), dtype=np.uint8))
    for code, args in (
        (3, ["nowhere.csv"]),
        (3, ["nan.csv"]),
        (3, ["board.csv", "--width", "3"]),
        (3, ["board.csv", "--scan", "nowhere.ptx"]),
        (3, ["board.csv", "--noise", "lidar"]),
        (3, ["board.csv", "--image", "nowhere.png"]),
        (3, ["board.csv", "--image", "small.png"]),
        (3, ["board.csv", "--image", "board.csv"]),
        (2, ["board.csv", "--models", "D2"]),
        (2, ["board.csv", "--models", ","]),
        (2, ["board.csv", "--min-effect", "3"]),
        (2, ["board.csv", "-o", "mine"]),
        (4, ["board.csv", "--models", "D1", "-o", "mine/thesis.txt/out"]),
    ):
        assert main(["calibrate", *args, "--quiet"]) == code, args
        out, err = capsys.readouterr()
        assert (out, len(err.splitlines())) == ("", 1), args
    assert main(["calibrate", "board.csv", "--models", "D1", "-o", "out", "--quiet"]) == 0
    assert main(["calibrate", "board.csv", "--models", "D3", "-o", "out", "--quiet"]) == 2
    assert main(["calibrate", "board.csv", "--models", "D3", "-o", "out", "--quiet", "--force"]) == 0
    assert not list(Path("out").glob("D1*"))
