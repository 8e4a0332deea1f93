"""A rig of two sensors: one pose per frame, in pose_offset_px and in the joint system."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, with_poses, with_rig
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.frames import claimed_frames
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.joint import audit_jointly
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.loaders.model import rotation_from_quat

PAIRS = dataclasses.replace(SPEC, num_images=8)


def with_moved_frame(model, frame, rotation, translation):
    """The rig of one frame moved in its own axes; the sensors stay where they are in it."""
    poses, frame_idx = model.images.pose_cam_from_rig, model.images.frame_idx
    quat, shift = model.images.quat_cam_from_world_wxyz.copy(), model.images.translation_cam_from_world.copy()
    for image in np.flatnonzero(frame_idx == frame):
        sensor = Rotation.from_quat(np.roll(poses[image, :4], -1))
        rig = sensor.inv() * Rotation.from_quat(np.roll(quat[image], -1))
        at = sensor.inv().apply(shift[image] - poses[image, 4:])
        turn = Rotation.from_rotvec(rotation)
        quat[image] = np.roll((sensor * turn * rig).as_quat(), 1)
        shift[image] = sensor.apply(turn.apply(at) + translation) + poses[image, 4:]
    return with_poses(model, quat, shift)


@pytest.fixture(scope="module")
def rig():
    return with_rig(model_of(PAIRS, seed=6))


def predicted(model, image_idx):
    image = model.image(image_idx)
    rows = slice(*model.observations.offsets[image_idx : image_idx + 2])
    xyz_cam = image.cam_from_world(model.points.xyz_world[model.observations.point_idx[rows]])
    return project(image.camera.model, image.camera.params, xyz_cam)


def test_the_offset_of_a_frame_is_what_moving_the_rig_would_remove(rig):
    """Against finite differences: the rig is moved, all its images are projected again."""
    frame, delta = 2, 1e-6
    residuals = ModelAuditor(rig).residuals
    assert (residuals.pose_offset_px[::2] == residuals.pose_offset_px[1::2]).all()
    columns = []
    for k in range(6):
        step = delta * np.eye(6)[k]
        moved = with_moved_frame(rig, frame, step[:3], step[3:])
        columns.append(np.concatenate([predicted(moved, i) - predicted(rig, i) for i in (4, 5)]).ravel() / delta)
    y = np.concatenate([residuals.residuals_px[:, residuals.rows(i)].T for i in (4, 5)]).ravel()
    explained = np.linalg.lstsq(np.array(columns).T, y, rcond=None)[0] @ np.array(columns)
    assert residuals.pose_offset_px[4] == pytest.approx(np.sqrt(explained @ explained / (len(y) / 2)), rel=1e-4)


@pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here")
@pytest.mark.parametrize("fault", ["none", "no pose", "nothing", "two points", "mixed"])
def test_offsets_of_frames_are_the_same_on_both_paths(rig, fault):
    translation = rig.images.translation_cam_from_world.copy()
    poses, point_idx = rig.images.pose_cam_from_rig.copy(), rig.observations.point_idx.copy()
    frame_idx, offsets = rig.images.frame_idx - 1, rig.observations.offsets
    if fault == "no pose":
        translation[3] = poses[3] = np.nan
    if fault == "nothing":
        point_idx[offsets[2] : offsets[4]] = -1
    if fault == "two points":  # do not fix the pose of their frame
        point_idx[offsets[4] + 1 : offsets[5]] = point_idx[offsets[5] + 1 : offsets[6]] = -1
    if fault == "mixed":
        frame_idx = np.array([3, 1, 1, 3, 0, 2, 2, 0])
    images = dataclasses.replace(
        rig.images, translation_cam_from_world=translation, pose_cam_from_rig=poses, frame_idx=frame_idx
    )
    observations = dataclasses.replace(rig.observations, point_idx=point_idx)
    model = dataclasses.replace(rig, images=images, observations=observations)
    found = model_residuals(model).pose_offset_px
    with numpy_only():
        assert_allclose(found, model_residuals(model).pose_offset_px, rtol=1e-9)
    assert np.isnan(found).sum() == {"nothing": 2}.get(fault, 0)


def test_a_frame_of_one_image_is_an_image(rig):
    images = dataclasses.replace(rig.images, frame_idx=np.arange(8))
    alone = ModelAuditor(dataclasses.replace(rig, images=images)).residuals.pose_offset_px
    images = dataclasses.replace(rig.images, frame_idx=None, pose_cam_from_rig=None)
    expected = ModelAuditor(dataclasses.replace(rig, images=images)).residuals.pose_offset_px
    assert_allclose(alone, expected, rtol=1e-9)


def test_a_moved_sensor_is_no_moved_rig_and_a_moved_rig_is_seen_in_all_its_images(rig):
    moved = with_moved_frame(rig, 1, np.array([0.004, 0.0, 0.0]), np.zeros(3))
    offsets = ModelAuditor(moved).residuals.pose_offset_px
    assert np.flatnonzero(offsets > 0.5).tolist() == [2, 3]
    tables = ModelAuditor(moved).tables().images
    assert tables["verdict_pose"].to_pylist() == ["accepted"] * 2 + ["rejected"] * 2 + ["accepted"] * 4


def test_the_joint_system_has_six_pose_columns_per_frame(rig):
    auditor, frames = ModelAuditor(rig), claimed_frames(rig)
    assert auditor.joint is not None
    expected = audit_jointly(
        rig,
        auditor.residuals,
        auditor.sigma_constant_px,
        alpha=auditor.config.alpha,
        tau_px=auditor.tau_px,
        frame_idx=np.repeat(np.arange(4), 2),
        image_from_frame=frames.image_from_frame,
    )
    free = audit_jointly(
        rig, auditor.residuals, auditor.sigma_constant_px, alpha=auditor.config.alpha, tau_px=auditor.tau_px
    )
    for found, wanted, unbound in zip(auditor.joint.steps, expected.steps, free.steps, strict=True):
        assert_allclose(found.sd, wanted.sd, rtol=1e-9)
        assert (found.sd < unbound.sd).all()  # a rig that holds knows more
    assert_allclose(frames.image_from_frame[::2], np.tile(np.eye(6), (4, 1, 1)), atol=1e-12)
    assert_allclose(frames.image_from_frame[1, :3, :3], rotation_from_quat(rig.images.pose_cam_from_rig[1, :4]))


def test_a_model_without_frames_claims_none():
    assert claimed_frames(model_of(PAIRS, seed=6)) is None
