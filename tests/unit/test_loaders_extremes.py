"""Findings for numbers that are finite and cannot be true, and for rigs that contradict the images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_writer import Frame, Rig, noisy_model, rig_model, write_binary, write_text
from placed_models import open_model

from sfm_audit.loaders import FindingCode

CAMERA = (500.0, 320.0, 240.0, 0.0)


def codes(folder: Path, model) -> dict[str, int]:
    return {str(finding.code): finding.count for finding in open_model(write_binary(folder, model)).findings}


def with_camera(**changes):
    model = noisy_model()
    return model.but(cameras=(replace(model.cameras[0], **changes), model.cameras[1]))


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 0},
        {"height": 0},
        {"params": (0.0, *CAMERA[1:])},
        {"params": (0.63, *CAMERA[1:])},
        {"params": (6.5e6, *CAMERA[1:])},
        {"params": (-0.63, *CAMERA[1:])},
        {"params": (1e-320, *CAMERA[1:])},
        {"params": (500.0, 1e100, 240.0, 0.0)},
        {"params": (*CAMERA[:3], 1.1e6)},
        {"model_id": 17, "params": (0.0, 480.0)},
    ],
)
def test_a_camera_that_cannot_be_one_is_a_finding(tmp_path: Path, changes):
    assert codes(tmp_path, with_camera(**changes))["implausible_cameras"] == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"params": (0.65, *CAMERA[1:])},
        {"params": (6.3e6, *CAMERA[1:])},
        {"params": (-500.0, *CAMERA[1:])},
        {"params": (*CAMERA[:3], 0.9e6)},
        {"params": (float("nan"), *CAMERA[1:])},
    ],
)
def test_what_may_be_a_bad_fit_and_what_is_not_finite_is_not_that_finding(tmp_path: Path, changes):
    assert "implausible_cameras" not in codes(tmp_path, with_camera(**changes))


@pytest.mark.parametrize(("value", "is_extreme"), [(0.9e12, False), (1.1e12, True), (-1.1e12, True), (1e308, True)])
def test_a_number_above_1e12_is_a_finding(tmp_path: Path, value: float, is_extreme: bool):
    model = noisy_model()
    image, point = model.images[0], model.points[0]
    pose = model.but(images=(replace(image, pose=(*image.pose[:6], value)), *model.images[1:]))
    xyz = model.but(points=(replace(point, xyz=(value, 0.0, 5.0)), *model.points[1:]))
    error = model.but(points=(replace(point, error=abs(value)), *model.points[1:]))
    xy = model.but(
        images=(replace(image, points2d=tuple((value, y, k) for _, y, k in image.points2d)), *model.images[1:])
    )
    num_linked = sum(k < 2**63 for _, _, k in image.points2d)
    for number, (changed, count) in enumerate([(pose, 1), (xyz, 1), (error, 1), (xy, num_linked)]):
        found = codes(tmp_path / str(number), changed)
        assert found.get("extreme_values", 0) == (count if is_extreme else 0)


def test_what_is_not_finite_has_its_own_findings(tmp_path: Path):
    model = noisy_model()
    infinite = model.but(points=(replace(model.points[0], xyz=(float("inf"), 0.0, 5.0)), *model.points[1:]))
    assert codes(tmp_path, infinite) == {"non_finite_points": 1}


def test_numbers_as_large_as_doubles_are_read_without_a_warning(tmp_path: Path):
    """Warnings are errors in these tests."""
    model = noisy_model()
    huge = tuple(replace(image, pose=(1e200, 1e200, -1e200, 1e308, 1e308, 0.0, 0.0)) for image in model.images)
    found = open_model(write_binary(tmp_path, model.but(images=huge)))
    image = found.image(0)
    assert not np.isfinite(image.rotation_cam_from_world).all()
    assert not np.isfinite(image.cam_from_world(np.full((3, 3), 1e300))).any()


def findings_but_poses(folder: Path):
    """Findings without that on the poses in the images file: those of `rig_model` are meant to differ."""
    return tuple(each for each in open_model(folder).findings if each.code != FindingCode.RIG_POSE_DISAGREES)


SENSORS = {
    "another sensor of the rig": ((0, 1, 3), (0, 1, 4), (1, 5, 77)),
    "a sensor that the rig lacks": ((0, 1, 3), (0, 99, 4), (1, 5, 77)),
}


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("case", SENSORS)
def test_a_frame_that_disagrees_about_the_sensor_of_an_image_is_a_finding(tmp_path: Path, write, case: str):
    """pycolmap 4.1 refuses both (image.h:239, reconstruction.cc:445)."""
    model = rig_model()
    frames = (replace(model.frames[0], data=SENSORS[case]), model.frames[1])
    findings = findings_but_poses(write(tmp_path, model.but(frames=frames)))
    assert [(finding.code, finding.count) for finding in findings] == [(FindingCode.SENSORS_DISAGREE, 1)]
    assert "image 4" in findings[0].text


def test_rigs_and_frames_that_name_what_does_not_exist(tmp_path: Path):
    model = rig_model()
    extra = Rig(3, ((0, 55, None),))
    lost = Frame(10, 44, model.frames[0].pose, ())
    changed = model.but(rigs=(*model.rigs, extra), frames=(*model.frames, lost))
    (finding,) = findings_but_poses(write_binary(tmp_path, changed))
    assert (finding.code, finding.count) == (FindingCode.SENSORS_DISAGREE, 2)
    assert "rig 3 has camera 55, which does not exist, and 1 more" in finding.text


def test_a_sound_rig_has_no_such_finding(tmp_path: Path):
    assert findings_but_poses(write_binary(tmp_path, rig_model())) == ()


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (b" 1 2 3 0.75 ", b" 1 nan 3 0.75 ", "1 colours"),
        (b" 1 2 3 0.75 ", b" 1 9223372036854775808 3 0.75 ", "1 colours"),
        (b" 1 2 3 0.75 ", b" 1 2.5 3 0.75 ", "1 colours"),
        (b" 1 2 3 0.75 ", b" 1 2.0 3 0.75 ", "1 colours"),
        (b" 1 2 3 0.75 ", b" 1 2147483648 3 0.75 ", "1 colours"),
        (b"30.0 40.0 -1", b"inf 40.0 -1", "1 unlinked 2D points"),
        (b"\n90 1.0 ", b"\n90 nan ", "1 poses that rigs and frames replace"),
    ],
)
def test_text_that_colmap_refuses_where_nothing_is_read_from_is_told(tmp_path: Path, old: bytes, new: bytes, what: str):
    """pycolmap 4.1: "Check failed: line_stream >> ..." for each of them."""
    write_text(tmp_path, rig_model())
    for name in ("images.txt", "points3D.txt"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content.replace(old, new, 1))
    (finding,) = findings_but_poses(tmp_path)
    assert finding.code == FindingCode.NON_FINITE_UNUSED
    assert what in finding.text
