from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_writer import Frame, Rig, rig_model, write_binary, write_text
from numpy.testing import assert_allclose, assert_array_equal
from placed_models import open_model
from scipy.spatial.transform import Rotation

from sfm_audit.loaders import FindingCode

SOURCE = rig_model()
FRONT, BACK = (frame.pose for frame in SOURCE.frames)
STORED = SOURCE.images[0].pose
WRITERS = pytest.mark.parametrize("write", [write_binary, write_text])


def poses_of(model) -> np.ndarray:
    return np.hstack([model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world])


def rotation(pose) -> Rotation:
    return Rotation.from_quat(np.roll(pose[:4], -1))


@WRITERS
def test_poses_are_sensor_from_rig_times_rig_from_world(tmp_path: Path, write):
    model = open_model(write(tmp_path, SOURCE))
    side = SOURCE.rigs[0].sensors[1][2]
    poses = poses_of(model)
    assert_array_equal(poses[0], FRONT)  # the reference sensor
    assert_array_equal(poses[2], BACK)
    expected = rotation(side) * rotation(FRONT)  # SciPy's composition
    assert_allclose(rotation(poses[1]).as_matrix(), expected.as_matrix(), atol=1e-15)
    assert_allclose(poses[1, 4:], rotation(side).apply(FRONT[4:]) + np.array(side[4:]), atol=1e-15)
    assert model.findings == ()


@WRITERS
@pytest.mark.parametrize(
    ("changes", "kept", "reason"),
    [
        ({"frames": SOURCE.frames[:1]}, [2], "image 90 is in no frame"),
        ({"frames": (replace(SOURCE.frames[0], rig_id=5), SOURCE.frames[1])}, [0, 1], "rig 5, which does not exist"),
        ({"rigs": (Rig(2, ((0, 1, None),)),)}, [1], "image 4 has camera 7, which is not in rig 2"),
        ({"rigs": (Rig(2, ((0, 1, None), (0, 7, None))),)}, [1], "camera 7, which has no pose in rig 2"),
        ({"rigs": (Rig(2),)}, [0, 1, 2], "camera 1, which is not in rig 2"),
        ({"frames": (*SOURCE.frames, Frame(10, 2, BACK, ((0, 1, 3),)))}, [0], "image 3 is in 2 frames"),
        ({"frames": (SOURCE.frames[0], Frame(9, 2, BACK, ((1, 5, 90),)))}, [2], "image 90 is in no frame"),
        ({"rigs": (), "frames": SOURCE.frames}, [0, 1, 2], "which does not exist"),
    ],
)
def test_an_image_that_is_not_placed_keeps_its_own_pose(tmp_path: Path, write, changes, kept, reason):
    model = open_model(write(tmp_path, SOURCE.but(**changes)))
    assert np.flatnonzero((poses_of(model) == np.array(STORED)).all(axis=1)).tolist() == kept
    (finding,) = model.findings
    assert (finding.code, finding.count) == (FindingCode.INCOMPLETE_RIGS, len(kept))
    assert reason in finding.text


@WRITERS
def test_frames_of_images_that_do_not_exist_are_a_finding(tmp_path: Path, write):
    """Here COLMAP has lost images: they would be in the table if the images file held them."""
    frames = (*SOURCE.frames, Frame(10, 2, BACK, ((0, 1, 91), (0, 7, 92))))
    (finding,) = open_model(write(tmp_path, SOURCE.but(frames=frames))).findings
    assert (finding.code, finding.count) == (FindingCode.INCOMPLETE_RIGS, 2)
    assert finding.text == "frames consist of 2 images that do not exist, e.g. image 91"


@WRITERS
@pytest.mark.parametrize("missing", ["rigs", "frames"])
def test_one_of_the_two_files_alone_places_nothing(tmp_path: Path, write, missing: str):
    model = open_model(write(tmp_path, SOURCE.but(**{missing: None})))
    assert_array_equal(poses_of(model), [STORED] * 3)
    assert [finding.code for finding in model.findings] == [FindingCode.INCOMPLETE_RIGS]


@WRITERS
def test_empty_rigs_and_frames_are_those_of_an_old_model(tmp_path: Path, write):
    model = open_model(write(tmp_path, SOURCE.but(rigs=(), frames=())))
    assert_array_equal(poses_of(model), [STORED] * 3)
    assert model.findings == ()


def test_rotations_that_are_not_unit_are_not_normalised(tmp_path: Path):
    doubled = (*(2 * value for value in FRONT[:4]), *FRONT[4:])
    frames = (replace(SOURCE.frames[0], pose=doubled), SOURCE.frames[1])
    model = open_model(write_binary(tmp_path, SOURCE.but(frames=frames)))
    norms = np.linalg.norm(model.images.quat_cam_from_world_wxyz, axis=1)
    assert_allclose(norms, [2, 2, 1], rtol=1e-15)
    assert [(f.code, f.count) for f in model.findings] == [(FindingCode.NON_UNIT_QUATERNIONS, 2)]


def test_a_frame_pose_that_is_not_finite_is_a_finding(tmp_path: Path):
    frames = (replace(SOURCE.frames[0], pose=(float("inf"), *FRONT[1:])), SOURCE.frames[1])
    model = open_model(write_binary(tmp_path, SOURCE.but(frames=frames)))
    assert [(f.code, f.count) for f in model.findings] == [(FindingCode.NON_FINITE_POSES, 2)]


@WRITERS
def test_images_of_one_frame_are_told_with_where_their_sensors_are(tmp_path: Path, write):
    images = open_model(write(tmp_path, SOURCE)).images
    assert images.image_id.tolist() == [3, 4, 90]
    assert images.frame_idx is not None
    assert images.frame_idx[0] == images.frame_idx[1] != images.frame_idx[2]
    identity = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert_array_equal(images.pose_cam_from_rig, [identity, SOURCE.rigs[0].sensors[1][2], identity])


@WRITERS
@pytest.mark.parametrize("changes", [{"rigs": None}, {"frames": ()}, {"rigs": (Rig(2, ((0, 1, None),)),)}])
def test_where_no_two_images_are_placed_together_there_are_no_frames(tmp_path: Path, write, changes):
    images = open_model(write(tmp_path, SOURCE.but(**changes))).images
    assert images.frame_idx is None
    assert images.pose_cam_from_rig is None
