"""Readers of reference poses: numbers by hand and from the formats' own words, matching of names, damage."""

from __future__ import annotations

import numpy as np
import pytest
from model_writer import Camera, Image, Model, Point, write_binary, write_text
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from sfm_audit.loaders import LoadError, open_model
from sfm_audit.loaders.evidence import NotAsked
from sfm_audit.loaders.references.formats import place_of_reference, read_poses, reference_of
from sfm_audit.loaders.references.image_lists import read_imc
from sfm_audit.loaders.references.matching import poses_of_images, rows_by_name
from sfm_audit.loaders.references.poses import PoseList

RNG = np.random.default_rng(5)
TURNS = Rotation.random(4, random_state=5)  # camera from world
CENTRES = RNG.normal(0, 10, (4, 3))
WORLD = TURNS.inv()


def tum(times=(1.0, 1.05, 1.1, 1.15)):
    rows = zip(times, CENTRES, WORLD.as_quat(), strict=True)
    lines = [f"{t:.6f} {' '.join(map(repr, map(float, [*c, *q])))}" for t, c, q in rows]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n"


def kitti():
    rows = [np.c_[m, c].ravel() for m, c in zip(WORLD.as_matrix(), CENTRES, strict=True)]
    return "\n".join(" ".join(f"{v:.9e}" for v in row) for row in rows) + "\n"


def imc(name="image_path", sep=";", names=("a.png", "b.png", "c.png", "d.png"), scenes=("s", "s", "s", "t")):
    lines = [f"dataset,scene,{name},rotation_matrix,translation_vector"]
    shifts = -TURNS.apply(CENTRES)
    for image, scene, m, t in zip(names, scenes, TURNS.as_matrix(), shifts, strict=True):
        rotation, shift = (sep.join(map(repr, map(float, v))) for v in (m.ravel(), t))
        lines.append(f"d,{scene},{image},{rotation},{shift}")
    return "\n".join(lines) + "\n"


def euroc(folder):
    body_from_cam = np.eye(4)
    body_from_cam[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    body_from_cam[:3, 3] = [0.1, 0.2, 0.3]
    (folder / "cam0").mkdir()
    numbers = ", ".join(map(repr, map(float, body_from_cam.ravel())))
    (folder / "cam0" / "sensor.yaml").write_text(f"sensor_type: camera\nT_BS:\n  cols: 4\n  data: [{numbers}]\n")
    (folder / "state").mkdir()
    world_from_body = WORLD * Rotation.from_matrix(body_from_cam[:3, :3]).inv()
    centre = CENTRES - world_from_body.apply(body_from_cam[:3, 3])
    quats = world_from_body.as_quat()[:, [3, 0, 1, 2]]
    lines = [
        ",".join([str(10**18 + i * 5 * 10**6), *map(repr, map(float, [*c, *q])), *["0"] * 9])
        for i, (c, q) in enumerate(zip(centre, quats, strict=True))
    ]
    path = folder / "state" / "data.csv"
    path.write_text("#timestamp, p_RS_R_x [m]\n" + "\n".join(lines) + "\n")
    return path


def written(folder, text, name="poses.txt"):
    path = folder / name
    path.write_text(text)
    return path


def check(poses, rows=slice(None)):
    assert_allclose(poses.centre[rows], CENTRES[rows], atol=1e-6)
    assert_allclose(poses.rotation[rows], TURNS.as_matrix()[rows], atol=1e-6)


def test_trajectories_are_cameras_in_the_world(tmp_path):
    for text in (tum(), kitti()):
        poses = read_poses(written(tmp_path, text))
        check(poses)
        assert poses.is_metric


def test_euroc_is_the_camera_not_the_body(tmp_path):
    path = euroc(tmp_path)
    poses = read_poses(path)
    check(poses)
    assert_allclose(np.diff(poses.seconds), 0.005, rtol=1e-4)
    (tmp_path / "cam0" / "sensor.yaml").unlink()
    with pytest.raises(LoadError, match=r"cam0/sensor\.yaml"):
        read_poses(path)


@pytest.mark.parametrize(("name", "sep"), [("image_id", " "), ("image_path", ";"), ("image_name", ";"), ("image", ";")])
def test_the_challenges_of_four_years(tmp_path, name, sep):
    poses = read_poses(written(tmp_path, imc(name, sep), "train_labels.csv"))
    check(poses)
    assert (poses.names[0], poses.scene[3], poses.is_metric) == ("a.png", "t", False)


def test_an_image_without_a_pose_is_not_known(tmp_path):
    lines = imc().splitlines()
    lines[2] = "d,s,b.png," + ";".join(["nan"] * 9) + "," + ";".join(["nan"] * 3)
    poses = read_imc(written(tmp_path, "\n".join(lines) + "\n"))
    found = poses_of_images(poses, ["x/a.png", "b.png"], "s")
    assert_allclose(found.centre[0], CENTRES[0])
    assert np.isnan(found.centre[1]).all()


def test_times_between_poses_are_interpolated(tmp_path):
    poses = read_poses(written(tmp_path, tum((1.0, 1.05, 1.1, 2.0))))
    found = poses_of_images(poses, ["1.05.png", "rgb/1.025.png", "1.5.png", "0.9.png", "x.png"], "")
    assert_allclose(found.centre[0], CENTRES[1])
    assert_allclose(found.centre[1], CENTRES[:2].mean(axis=0))
    middle = Slerp([0, 1], TURNS[:2])(0.5).as_matrix()
    assert_allclose(found.rotation[1], middle, atol=1e-9)
    assert np.isnan(found.centre[2:]).all()  # a gap of 0.9 s, before the first, and no time at all
    assert found.is_metric


def test_frames_are_counted_from_zero(tmp_path):
    poses = read_poses(written(tmp_path, kitti()))
    found = poses_of_images(poses, ["image_0/000002.png", "000004.png"], "")
    assert_allclose(found.centre[0], CENTRES[2], atol=1e-6)
    assert np.isnan(found.centre[1]).all()


def test_names_match_whole_then_by_their_last_part_then_without_ending():
    stored = ["a/1.jpg", "b/1.jpg", "a/2.jpg", "3"]
    assert rows_by_name(stored, range(4), ["b/1.jpg", "2.jpg", "c/3.png", "c/1.jpg"]).tolist() == [1, 2, 3, -1]
    assert rows_by_name(stored, [0, 2], ["c/1.jpg"]).tolist() == [0]


def test_of_a_file_with_several_scenes_the_model_s_own_is_meant():
    poses = PoseList("x", TURNS[:2].as_matrix(), CENTRES[:2], False, ("a", "a"), scene=("one", "two"))
    assert_allclose(poses_of_images(poses, ["a"], "two").centre[0], CENTRES[1])
    with pytest.raises(LoadError, match="none of them"):
        poses_of_images(poses, ["a"], "three")


@pytest.fixture
def sample():
    quats = TURNS.as_quat()[:, [3, 0, 1, 2]]
    shifts = -TURNS.apply(CENTRES)
    images = tuple(
        Image(i + 1, f"{n}.jpg", ((1.0, 2.0, 7),), (*map(float, q), *map(float, t)))
        for i, (n, q, t) in enumerate(zip("abcd", quats, shifts, strict=True))
    )
    return Model((Camera(),), images, (Point(7, tuple((i + 1, 0) for i in range(4))),))


def test_a_model_is_a_reference_by_its_folder_its_file_or_its_images_alone(tmp_path, sample):
    folder = write_text(tmp_path / "whole", sample)
    check(read_poses(folder))
    check(read_poses(folder / "images.txt"))
    (tmp_path / "alone").mkdir()
    alone = tmp_path / "alone" / "images.txt"
    alone.write_bytes((folder / "images.txt").read_bytes())
    check(read_poses(alone))
    check(read_poses(alone.parent))
    assert not read_poses(alone).is_metric


def test_a_tree_has_a_model_at_the_same_path(tmp_path, sample):
    folder = write_binary(tmp_path / "tree" / "scene" / "sparse" / "0", sample)
    model = open_model(folder)
    assert place_of_reference(str(tmp_path / "tree"), "scene/sparse/0") == folder
    found = reference_of(model, str(tmp_path / "tree"), "scene/sparse/0", "")
    assert_allclose(found.centre, CENTRES, atol=1e-6)
    silent = reference_of(model, str(tmp_path / "tree"), "other/sparse/0", "")
    assert isinstance(silent, NotAsked)
    assert "other/sparse/0" in silent.reason
    with pytest.raises(LoadError, match="nothing"):
        reference_of(model, str(tmp_path / "not there"), "", "")


def test_a_reference_of_other_images_is_not_asked(tmp_path, sample):
    model = open_model(write_binary(tmp_path / "m", sample))
    for text, name in ((imc(names=("w", "x", "y", "z")), "l.csv"), (tum(), "t.txt"), (kitti(), "k.txt")):
        found = reference_of(model, str(written(tmp_path, text, name)), "", "")
        assert isinstance(found, NotAsked), name
        assert "\n" not in found.reason


TEXTS = {"tum": tum, "kitti": kitti, "imc": imc}


@pytest.mark.parametrize("kind", TEXTS)
def test_cut_anywhere_it_is_refused_or_shorter(tmp_path, kind):
    """Cut at the end of a line, a trajectory is a shorter one; cut elsewhere it is refused in one line."""
    content = TEXTS[kind]().encode()
    path = tmp_path / "cut.txt"
    for size in range(0, len(content), 13):
        path.write_bytes(content[:size])
        try:
            poses = read_poses(path)
        except LoadError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert content[size - 1 : size] == b"\n"
            check(poses, slice(len(poses)))  # nothing of it is another pose


@pytest.mark.parametrize("odd", ["nan", "inf", "1e400", "x", "1_0", "", "0x1p3", "1,5", "\0"])
@pytest.mark.parametrize("kind", TEXTS)
def test_odd_numbers_are_refused_or_not_known(tmp_path, kind, odd):
    lines = TEXTS[kind]().splitlines()
    comma = "," if kind == "imc" else " "
    for column in range(len(lines[-1].split(comma))):
        cells = lines[-1].split(comma)
        cells[column] = odd
        path = written(tmp_path, "\n".join([*lines[:-1], comma.join(cells)]) + "\n")
        try:
            poses = read_poses(path)
        except LoadError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert not np.isinf(poses.rotation).any()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("1 2 3\n", "3 values"),
        (kitti().replace("e-01", "e+02"), "a rotation matrix"),
        (tum() + "2 0 0 0 0 0 0 0\n", "a quaternion"),
        ("1e300 0 0 0 0 0 0 1\n", "a timestamp"),
        (tum() + "2 0 0 0 0 0 0\n", "8 numbers"),
        (imc().replace("rotation_matrix", "rotation_matrix,image"), "cells"),
        ("rotation_matrix,translation_vector\n1,2\n", "columns"),
        ("image,rotation_matrix,translation_vector\na,1;0;0,1;0;0\n", "9 numbers"),
        ("image,rotation_matrix,translation_vector\n", "poses"),
        ("# nothing\n", "values"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, what):
    with pytest.raises(LoadError, match=what):
        read_poses(written(tmp_path, text))


def test_a_time_that_is_a_pose_s_needs_no_second_one(tmp_path):
    """Key frames 2 s apart; stamps that are rounded otherwise, also of the first and the last pose."""
    poses = read_poses(written(tmp_path, tum((1.0, 3.0, 5.0, 7.0))))
    found = poses_of_images(poses, ["0.99995.png", "3.0.png", "5.00005.png", "7.00005.png", "3.001.png"], "")
    assert_allclose(found.centre[:4], CENTRES)
    assert_allclose(found.rotation[:4], TURNS.as_matrix(), atol=1e-6)
    assert np.isnan(found.centre[4]).all()


def test_poses_at_ten_hertz_are_near_enough(tmp_path):
    """A step of 0.1 s is a little more in binary."""
    start = 1403636580.838556
    poses = read_poses(written(tmp_path, tum(tuple(start + k / 10 for k in range(4)))))
    found = poses_of_images(poses, [f"{start + k / 10 + 0.05:.6f}.png" for k in range(3)], "")
    assert np.isfinite(found.centre).all()


def test_centres_that_no_number_holds_squared_are_not_known(tmp_path):
    poses = read_poses(written(tmp_path, tum()))
    poses.centre[1] = 1e200
    found = poses_of_images(poses, ["1.0.png", "1.05.png"], "")
    assert_allclose(found.centre[0], CENTRES[0])
    assert np.isnan(found.centre[1]).all()
