"""The candidate fields against what larger cameras really do, by finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_reference import HEIGHT, WIDTH, camera, points
from numpy.testing import assert_allclose

from sfm_audit.audit.cameras import project
from sfm_audit.audit.misfit import MisfitGroup, candidate_fields, fitted_param_idxs, nuisance_columns, project_image
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.simulate.defects import DefectKind, with_defect
from sfm_audit.audit.simulate.truth import NUM_TRUE_PARAMS, TrueCameras, project_true
from sfm_audit.loaders.camera_models import BY_NAME

STEP = 1e-6


def fields_of(cam, xyz, group):
    return candidate_fields(cam, project_image(cam, xyz))[GROUP_COLUMNS[group]]


def by_difference(name, params, index, xyz):
    """(2, n) d projection / d parameter."""
    up, down = np.array(params, dtype=float), np.array(params, dtype=float)
    up[index] += STEP
    down[index] -= STEP
    model = BY_NAME[name]
    return (project(model, up, xyz) - project(model, down, xyz)).T / (2 * STEP)


# The larger model's parameters at the same camera, and where the group's two coefficients are among them.
LENSES = [
    (camera("SIMPLE_RADIAL"), MisfitGroup.RADIAL, "FULL_OPENCV", (-0.05, 0, 0, 0, 0, 0, 0, 0), (5, 8)),
    (camera("PINHOLE"), MisfitGroup.RADIAL, "FULL_OPENCV", (0,) * 8, (5, 8)),
    (camera("SIMPLE_RADIAL"), MisfitGroup.TANGENTIAL, "OPENCV", (-0.05, 0, 0, 0), (6, 7)),
    (camera("SIMPLE_RADIAL_FISHEYE"), MisfitGroup.RADIAL, "OPENCV_FISHEYE", (-0.03, 0, 0, 0), (5, 6)),
    (
        camera("SIMPLE_RADIAL_FISHEYE"),
        MisfitGroup.TANGENTIAL,
        "THIN_PRISM_FISHEYE",
        (-0.03, 0, 0, 0, 0, 0, 0, 0),
        (6, 7),
    ),
]


@pytest.mark.parametrize(("cam", "group", "larger", "extra", "indices"), LENSES)
def test_lens_fields_are_the_coefficients_of_larger_models(cam, group, larger, extra, indices):
    xyz = points(np.random.default_rng(1), 40)
    params = camera(larger, extra).params
    expected = [by_difference(larger, params, index, xyz) for index in indices]
    assert_allclose(fields_of(cam, xyz, group), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("name", ["OPENCV", "OPENCV_FISHEYE"])
def test_affine_and_principal_point(name):
    xyz = points(np.random.default_rng(2), 40)
    cam = camera(name)
    affine = fields_of(cam, xyz, MisfitGroup.AFFINE)
    fx = by_difference(name, cam.params, 0, xyz)
    fy = by_difference(name, cam.params, 1, xyz)
    assert_allclose(affine[0], 1000.0 * fx, rtol=1e-6, atol=1e-4)  # px per unit of ln fx
    assert_allclose(affine[1, 0], 1000.0 * fy[1], rtol=1e-6, atol=1e-4)  # skew: the same in the other row
    assert (affine[1, 1] == 0).all()
    principal_point = fields_of(cam, xyz, MisfitGroup.PRINCIPAL_POINT)
    assert_allclose(principal_point[0] / 1000.0, by_difference(name, cam.params, 2, xyz), atol=1e-5)
    assert_allclose(principal_point[1] / 1000.0, by_difference(name, cam.params, 3, xyz), atol=1e-5)


@pytest.mark.parametrize("axis", range(6))
def test_rolling_shutter_is_what_a_moving_camera_does(axis):
    xyz = points(np.random.default_rng(3), 40)
    cam = camera("SIMPLE_RADIAL")
    params = np.zeros((1, NUM_TRUE_PARAMS))
    params[0, :5] = [1000.0, 1000.0, WIDTH / 2, HEIGHT / 2, -0.05]
    still = TrueCameras(
        BY_NAME["FULL_OPENCV"], WIDTH, HEIGHT, params, np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 6))
    )
    where = np.zeros(40, dtype=np.int64)
    motion = tuple(STEP * np.eye(6)[axis])
    moving = with_defect(still, 0, DefectKind.ROLLING_SHUTTER, motion)
    expected = (project_true(moving, where, xyz) - project_true(still, where, xyz)).T / STEP
    assert_allclose(fields_of(cam, xyz, MisfitGroup.ROLLING_SHUTTER)[axis], expected, rtol=1e-4, atol=0.05)


def test_smooth_is_every_monomial_of_degree_1_to_4_in_both_rows():
    xyz = points(np.random.default_rng(4), 40)
    cam = camera("OPENCV")
    x, y = (project(cam.model, cam.params, xyz) - [WIDTH / 2, HEIGHT / 2]).T / (WIDTH / 2)
    expected = [x**i * y**j for i in range(5) for j in range(5) if 1 <= i + j <= 4]
    found = fields_of(cam, xyz, MisfitGroup.SMOOTH)
    assert found.shape == (28, 2, 40)
    for row, own in ((0, found[:14]), (1, found[14:])):
        assert (own[:, 1 - row] == 0).all()
        for column in expected:
            assert min(np.abs(own[:, row] - column).max(axis=1)) < 1e-12


def test_nuisances_are_the_pose_and_what_colmap_refines():
    xyz = points(np.random.default_rng(5), 40)
    cam = camera("OPENCV")
    projected = project_image(cam, xyz)
    assert fitted_param_idxs(cam.model) == (0, 1, 4, 5, 6, 7)
    assert fitted_param_idxs(BY_NAME["EQUIRECTANGULAR"]) == ()
    columns = nuisance_columns(cam.model, projected)
    assert columns.shape == (12, 2, 40)
    for index, column in zip(fitted_param_idxs(cam.model), columns[6:], strict=True):
        assert_allclose(column, by_difference("OPENCV", cam.params, index, xyz), rtol=1e-6, atol=1e-5)
    for axis in range(3):
        shift = STEP * np.eye(3)[axis]
        expected = (project(cam.model, cam.params, xyz + shift) - project(cam.model, cam.params, xyz - shift)).T
        assert_allclose(columns[3 + axis], expected / (2 * STEP), rtol=1e-6, atol=1e-4)
    assert nuisance_columns(cam.model, projected, (0, 3)).shape == (8, 2, 40)
