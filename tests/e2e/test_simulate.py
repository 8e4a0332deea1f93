import json
import sys

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.board import BoardSpec, board_sets
from sfm_audit.audit.simulate.render import DetectorError
from sfm_audit.audit.simulate.room import RoomSpec, room_sets
from sfm_audit.loaders.correspondences.table import read_correspondences


def truth_of(folder):
    return json.loads((folder / "truth.json").read_text(encoding="utf-8"))


def same(read, made):
    assert (read.width, read.height) == (made.width, made.height)
    for name in ("xy_px", "xyz_world", "pan_xyz_world", "tilt_xyz_world"):
        assert_array_equal(getattr(read, name), getattr(made, name))


def test_boards_are_read_back_to_the_last_bit_with_their_truth_and_photographs(tmp_path, capsys):
    out = tmp_path / "boards"
    assert main(["simulate", "board", "-o", str(out), "--sets", "2", "--seed", "3", "--images"]) == 0
    assert capsys.readouterr().out == f"{out}: 2 sets of board, truth in truth.json\n"
    made = board_sets(BoardSpec(num_sets=2), 3, rendered=True)
    truth = truth_of(out)
    assert (truth["scene"], truth["seed"], truth["rendered"]) == ("board", 3, True)
    assert truth["spec"]["focal_px"] == 800.0
    for board, row in zip(made, truth["sets"], strict=True):
        same(read_correspondences(out / row["file"]), board.correspondences)
        assert row["coverage"] == board.coverage
        assert row["camera"]["coefficients"] == [-0.0684, 0.01, 0.0006]
        assert_array_equal(row["true_xy_px"], board.true_xy_px)
        assert_array_equal(row["rotation_cam_from_world"], board.rotation_cam_from_world)
        photograph = cv2.imread(str(out / row["file"].replace(".csv", ".png")), cv2.IMREAD_UNCHANGED)
        assert photograph.shape == (1600, 1600)
        assert photograph.dtype == np.uint8
    names = sorted(path.name for path in out.iterdir())
    assert names == ["set_000.csv", "set_000.png", "set_001.csv", "set_001.png", "truth.json"]


def test_rooms_and_points_only_boards(tmp_path, capsys):
    assert main(["simulate", "room", "-o", str(tmp_path / "r"), "--sets", "2", "--camera", "wide", "--quiet"]) == 0
    for room, row in zip(room_sets(RoomSpec("wide"), 0, 2), truth_of(tmp_path / "r")["sets"], strict=True):
        same(read_correspondences(tmp_path / "r" / row["file"]), room.correspondences)
        assert_array_equal(row["true_xyz_world"], room.true_xyz_world)
    assert main(["simulate", "board", "-o", str(tmp_path / "b"), "--points-only", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    made = board_sets(BoardSpec(), 0, rendered=False)
    truth = truth_of(tmp_path / "b")
    assert truth["rendered"] is False
    assert len(truth["sets"]) == 56
    same(read_correspondences(tmp_path / "b" / "set_055.csv"), made[-1].correspondences)


def test_points_only_and_rooms_need_no_opencv(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.delitem(sys.modules, "sfm_audit.audit.simulate.render")
    assert main(["simulate", "board", "-o", str(tmp_path / "a"), "--sets", "1", "--points-only"]) == 0
    assert main(["simulate", "room", "-o", str(tmp_path / "b"), "--sets", "1"]) == 0
    assert main(["simulate", "board", "-o", str(tmp_path / "c"), "--sets", "1"]) == 2
    assert 'cv2 is not installed; it belongs to the extra "calibrate"' in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_an_earlier_simulation_is_replaced_only_by_force(tmp_path, capsys):
    command = ["simulate", "room", "-o", str(tmp_path / "r"), "--quiet"]
    assert main([*command, "--sets", "3"]) == 0
    assert main(command) == 2
    assert "replace it with --force" in capsys.readouterr().err
    assert main([*command, "--sets", "1", "--force"]) == 0
    assert sorted(path.name for path in (tmp_path / "r").iterdir()) == ["set_000.csv", "truth.json"]
    (tmp_path / "r" / "thesis.tex").touch()
    assert main([*command, "--force"]) == 2
    assert "holds 'thesis.tex' too" in capsys.readouterr().err
    assert (tmp_path / "r" / "set_000.csv").exists()


def test_foreign_folders_and_files_are_left_alone(tmp_path, capsys):
    (tmp_path / "truth.json").write_text('{"made_by": "sfm-audit demo"}', encoding="utf-8")
    (tmp_path / "file").touch()
    for out in (tmp_path, tmp_path / "file"):
        assert main(["simulate", "room", "-o", str(out), "--force"]) == 2
        assert "is not an earlier simulation" in capsys.readouterr().err
    assert main(["simulate", "room", "-o", "/proc/room"]) == 4
    assert capsys.readouterr().err.count("\n") == 1


def test_a_lost_corner_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capsys):
    def lose(*_: object):
        raise DetectorError("3 of 225 corners found more than 0.5 px off (up to 0.61 px)")

    monkeypatch.setattr("sfm_audit.audit.simulate.render.detect_corners", lose)
    assert main(["simulate", "board", "-o", str(tmp_path / "b"), "--sets", "2"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("sfm-audit: the detector failed: 3 of 225 corners")
    assert message.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["house", "-o", "x"], "'house' is not one of"),
        (["board"], "Missing option '-o'"),
        (["board", "-o", "x", "--sets", "0"], "--sets"),
        (["board", "-o", "x", "--camera", "wide"], "--camera belongs to room"),
        (["board", "-o", "x", "--images", "--points-only"], "exclude each other"),
        (["room", "-o", "x", "--images"], "a room is not rendered"),
        (["room", "-o", "x", "--camera", "narrow"], "narrow"),
    ],
)
def test_wrong_usage_is_one_line_and_2(args, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *args]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
