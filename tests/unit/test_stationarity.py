"""What moving the pose alone would remove: against dense least squares and against pycolmap's own poses."""

import math

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import ModelAuditor
from sfm_audit.audit.cameras import project, project_with_jacobians
from sfm_audit.audit.inliers.stationarity import pose_columns, pose_offset_px
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders.camera_models import BY_NAME

CAMERA, PARAMS = BY_NAME["SIMPLE_RADIAL"], np.array([1000.0, 800.0, 600.0, -0.05])


def points(rng, n=200):
    return np.stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(4, 10, n)], axis=1)


def jacobian_of(xyz_cam):
    return project_with_jacobians(CAMERA, PARAMS, xyz_cam, with_params=False).d_xy_d_cam.transpose(1, 2, 0)


def test_columns_are_the_derivatives_by_rotation_and_translation():
    xyz = points(np.random.default_rng(0))
    columns = pose_columns(jacobian_of(xyz), xyz)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(step[:3]), step[3:])
        back = pycolmap.Rigid3d(pycolmap.Rotation3d(-step[:3]), -step[3:])
        ahead, behind = (project(CAMERA, PARAMS, np.array([rigid * p for p in xyz])) for rigid in (moved, back))
        assert_allclose(columns[k].T, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_offset_is_what_least_squares_removes(seed):
    rng = np.random.default_rng(seed)
    xyz = points(rng)
    residuals = rng.normal(size=(2, len(xyz)))
    columns = pose_columns(jacobian_of(xyz), xyz).reshape(6, -1).T
    removed = columns @ np.linalg.lstsq(columns, residuals.reshape(-1), rcond=None)[0]
    expected = math.sqrt(removed @ removed / len(xyz))
    assert pose_offset_px(residuals, jacobian_of(xyz), xyz) == pytest.approx(expected, rel=1e-9)


def test_degenerate_points_take_the_singular_value_path():
    xyz = np.tile([[0.3, 0.2, 5.0]], (30, 1))  # one point: the pose has two effects, not six
    residuals = np.random.default_rng(1).normal(size=(2, 30))
    expected = math.sqrt(30 * (residuals.mean(axis=1) ** 2).sum() / 30)
    assert pose_offset_px(residuals, jacobian_of(xyz), xyz) == pytest.approx(expected, rel=1e-6)
    assert math.isnan(pose_offset_px(np.empty((2, 0)), np.empty((2, 3, 0)), np.empty((0, 3))))


def test_a_pose_moved_after_adjustment_is_found_and_others_are_at_rest():
    defects = (DefectSpec(4, DefectKind.PERTURBED_POSE, 1.5),)
    scene = simulate_scene(SceneSpec(num_images=12, points_per_image=200, defects=defects), np.random.default_rng(4))
    offsets = ModelAuditor(sparse_model(scene, adjust_scene(scene))).residuals.pose_offset_px
    assert offsets[4] == pytest.approx(1.5, rel=0.15)
    assert np.delete(offsets, 4).max() < 1e-3
