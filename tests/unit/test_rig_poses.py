"""Poses of the images file beside those of frames and rigs, and rigs that are not rigid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from joint_reference import SPEC, model_of, with_rig
from model_writer import Camera, Frame, Image, Model, Rig, write_binary
from scipy.spatial.transform import Rotation

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.rigs import ask_rigs
from sfm_audit.loaders import open_model
from sfm_audit.loaders.model import FindingCode

BASE = (0.8, 0.0, 0.6, 0.0, 0.2, 0.0, 0.0)


def frames_and_poses(num=4):
    """Two cameras in a rig and their true poses, composed by SciPy."""
    frames, poses = [], {}
    sensor, offset = Rotation.from_quat([0.0, 0.6, 0.0, 0.8]), np.array(BASE[4:])
    for k in range(num):
        rig = Rotation.from_euler("y", 20 * k, degrees=True)
        shift = np.array([0.5 * k, 0.1, 4.0])
        quat = np.roll(rig.as_quat(), 1)
        frames.append(Frame(k + 1, 1, (*quat, *shift), ((0, 1, 2 * k + 1), (0, 2, 2 * k + 2))))
        poses[2 * k + 1] = (*quat, *shift)
        poses[2 * k + 2] = (*np.roll((sensor * rig).as_quat(), 1), *(sensor.apply(shift) + offset))
    return tuple(frames), poses


def found(tmp_path: Path, changed=None):
    frames, poses = frames_and_poses()
    poses |= changed or {}
    images = tuple(Image(i, f"{i}.jpg", (), poses[i], camera_id=1 + (i % 2 == 0)) for i in poses)
    rig = Rig(1, ((0, 1, None), (0, 2, BASE)))
    model = open_model(write_binary(tmp_path / "m", Model((Camera(1), Camera(2)), images, (), (rig,), frames)))
    return [each for each in model.findings if each.code is FindingCode.RIG_POSE_DISAGREES]


def test_equal_poses_are_no_finding_whatever_the_sign_of_the_quaternion(tmp_path):
    assert found(tmp_path) == []
    _, poses = frames_and_poses()
    assert found(tmp_path, {3: (*(-x for x in poses[3][:4]), *poses[3][4:])}) == []


@pytest.mark.parametrize("image_id", [1, 4])
def test_a_stale_pose_is_named(tmp_path, image_id):
    _, poses = frames_and_poses()
    turned = Rotation.from_euler("x", 2, degrees=True) * Rotation.from_quat(np.roll(poses[image_id][:4], -1))
    (finding,) = found(tmp_path, {image_id: (*np.roll(turned.as_quat(), 1), *poses[image_id][4:])})
    assert finding.count == 1
    assert f"for 1 of 8 images: up to 2 degrees (image {image_id})" in finding.text


def test_a_place_that_is_no_number_leaves_the_angle(tmp_path):
    _, poses = frames_and_poses()
    turned = Rotation.from_euler("x", 2, degrees=True) * Rotation.from_quat(np.roll(poses[4][:4], -1))
    (finding,) = found(tmp_path, {4: (*np.roll(turned.as_quat(), 1), np.nan, np.nan, np.nan)})
    assert "up to 2 degrees (image 4); programs" in finding.text


def test_a_shifted_pose_is_one_too(tmp_path):
    _, poses = frames_and_poses()
    shifted = (*poses[2][:4], *(np.array(poses[2][4:]) + np.array([0.0, 0.0, 0.1])))
    assert [each.count for each in found(tmp_path, {2: shifted})] == [1]


def asked(model):
    auditor = ModelAuditor(model)
    return ask_rigs(Evidence(model, auditor.residuals, auditor.sigma_constant_px))


@pytest.fixture(scope="module")
def rig():
    return with_rig(model_of(replace(SPEC, num_images=8), seed=6))


def test_a_rigid_rig_is_silent(rig):
    report = asked(rig)
    assert report.findings == ()
    assert np.nanmax(report.columns["rig_offset_px"]) < 0.5
    assert asked(replace(rig, images=replace(rig.images, frame_idx=None, pose_cam_from_rig=None))) is None


def test_a_camera_that_turns_in_its_rig_is_named(rig):
    """Turned by 0.1 degrees, another way in every frame: the frame cannot follow."""
    images = rig.images
    quat = images.quat_cam_from_world_wxyz.copy()
    translation = images.translation_cam_from_world.copy()
    camera_id = images.camera_id.copy()
    camera_id[1::2], camera_id[::2] = 9, 8
    for k, image_idx in enumerate(range(1, len(quat), 2)):
        turn = Rotation.from_rotvec([0.004 * (-1) ** k, 0.0, 0.0])
        quat[image_idx] = np.roll((turn * Rotation.from_quat(np.roll(quat[image_idx], -1))).as_quat(), 1)
        translation[image_idx] = turn.apply(translation[image_idx])
    changed = replace(
        images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation, camera_id=camera_id
    )
    (finding,) = asked(replace(rig, images=changed)).findings
    assert finding.code is FindingCode.RIG_NOT_CONSTANT
    assert "camera 9 in 4 of 4 frames" in finding.text
    assert "camera 8" not in finding.text
