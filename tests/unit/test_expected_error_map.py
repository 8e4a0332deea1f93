"""Expected measurement error against the scatter of predictions of refitted cameras (method.md section 6)."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.camera_quality.expected_error import (
    expected_error_map,
    expected_error_px,
    grid_columns,
    grid_rays,
    measurement_error_px,
    median_depth,
)
from sfm_audit.audit.camera_quality.identifiability import fitted_names, parameter_covariance
from sfm_audit.audit.camera_quality.shapes import cell_centres_px
from sfm_audit.audit.cameras import project
from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.misfit.nuisance import nuisance_columns
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord


def camera_of(name="SIMPLE_RADIAL", params=(1000.0, 800.0, 600.0, -0.05), width=1600, height=1200):
    return CameraRecord(1, BY_NAME[name], width, height, np.array(params))


def points(rng, n=120, spread=0.5):
    depth = rng.uniform(4.0, 10.0, n)
    return np.column_stack([rng.uniform(-spread, spread, (n, 2)) * depth[:, None], depth])


def covariance_of(camera, xyz_cam, sigma):
    columns = nuisance_columns(camera.model, project_image(camera, xyz_cam))
    return columns, parameter_covariance(columns, fitted_names(camera.model), sigma)


def test_is_the_scatter_of_predictions_plus_two_axes_of_noise():
    rng = np.random.default_rng(1)
    camera, sigma = camera_of(), 2.0
    xyz_cam = points(rng, 60)
    columns, parameters = covariance_of(camera, xyz_cam, sigma)
    depth = median_depth(camera, xyz_cam)
    found = expected_error_map(camera, parameters, sigma, depth, grid=4)
    rays = grid_rays(camera, 4)
    targets = rays / rays[:, 2:] * depth
    linear = np.linalg.pinv(columns.transpose(2, 1, 0).reshape(120, -1))
    square = np.zeros(16)
    for _ in range(2000):
        theta = linear @ rng.normal(0, sigma, 120)
        params = camera.params + np.array([theta[6], 0, 0, theta[7]])
        shifted = Rotation.from_rotvec(theta[:3]).apply(targets) + theta[3:6]
        error = project(camera.model, params, shifted) - found.xy_px.reshape(-1, 2) + rng.normal(0, sigma, (16, 2))
        square += (error**2).sum(axis=1)
    assert_allclose(found.error_px.ravel() / np.sqrt(square / 2000), 1.0, atol=0.06)
    assert found.median_px == np.median(found.error_px)


def test_pixels_are_cell_centres_and_rays_go_through_them():
    camera = camera_of("OPENCV", (900.0, 950.0, 810.0, 590.0, -0.05, 0.01, 1e-3, 2e-3))
    pixels = cell_centres_px(1600, 1200, 16)
    assert pixels.shape == (16, 16, 2)
    assert_allclose(pixels[0, 0], [50.0, 37.5])
    assert_allclose(pixels[2, 15], [1550.0, 187.5])
    theirs = pycolmap.Camera(model="OPENCV", width=1600, height=1200, params=camera.params)
    assert_allclose(theirs.img_from_cam(grid_rays(camera)), pixels.reshape(-1, 2), atol=1e-8)


@settings(max_examples=20)
@given(unit=st.sampled_from([1e-3, 0.5, 1e3]), sigma=st.floats(0.05, 5.0))
def test_scales_with_the_noise_and_ignores_the_unit_of_the_world(unit, sigma):
    camera = camera_of()
    xyz_cam = points(np.random.default_rng(0))
    _, parameters = covariance_of(camera, xyz_cam, 1.0)
    reference = expected_error_map(camera, parameters, 1.0, median_depth(camera, xyz_cam))
    _, parameters = covariance_of(camera, unit * xyz_cam, sigma)
    found = expected_error_map(camera, parameters, sigma, median_depth(camera, unit * xyz_cam))
    assert_allclose(found.error_px, sigma * reference.error_px, rtol=1e-6)


def test_is_never_below_the_noise_and_grows_where_nothing_was_observed():
    rng = np.random.default_rng(4)
    camera = camera_of()
    depth = rng.uniform(4, 10, 100)
    corner = np.column_stack([rng.uniform(-0.75, -0.4, 100) * depth, rng.uniform(-0.55, -0.3, 100) * depth, depth])
    _, parameters = covariance_of(camera, corner, 0.5)
    error = expected_error_map(camera, parameters, 0.5, median_depth(camera, corner)).error_px
    assert (error > 0.5 * np.sqrt(2.0)).all()
    assert error[-1, -1] > 3.0 * error[3, 3]


def test_pixels_without_a_ray_are_nan_and_do_not_count():
    camera = camera_of(params=(1000.0, 800.0, 600.0, -0.5))  # folds before the corners
    xyz_cam = points(np.random.default_rng(0), spread=0.3)
    _, parameters = covariance_of(camera, xyz_cam, 0.5)
    found = expected_error_map(camera, parameters, 0.5, 6.0)
    assert np.isnan(found.error_px[0, 0])
    assert np.isfinite(found.error_px[8, 8])
    assert np.isfinite(found.median_px)


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("EQUIRECTANGULAR", (1600.0, 1200.0)),
        ("OPENCV_FISHEYE", (600.0, 600.0, 800.0, 600.0, 0.01, 0.0, 0.0, 0.0)),
        ("FOV", (900.0, 900.0, 800.0, 600.0, 0.8)),
        ("SIMPLE_DIVISION", (900.0, 800.0, 600.0, -0.1)),
    ],
)
def test_works_for_other_families(name, params):
    camera = camera_of(name, params)
    xyz_cam = points(np.random.default_rng(0))
    _, parameters = covariance_of(camera, xyz_cam, 0.5)
    found = expected_error_map(camera, parameters, 0.5, median_depth(camera, xyz_cam))
    assert found.median_px > 0.5 * np.sqrt(2.0)
    depth = median_depth(camera, xyz_cam)
    columns = grid_columns(camera, rays=grid_rays(camera))
    again = expected_error_map(camera, parameters, 0.5, depth, columns=columns)
    assert_allclose(again.error_px, found.error_px, rtol=1e-12)
    there = grid_rays(camera) * depth / (1.0 if camera.model.is_spherical else grid_rays(camera)[:, 2:])
    jacobian = nuisance_columns(camera.model, project_image(camera, there))
    error = measurement_error_px(jacobian, fitted_names(camera.model), parameters, 0.5)
    assert_allclose(found.error_px.ravel(), error, rtol=1e-9)
    assert_allclose(expected_error_px(camera, parameters, 0.5, depth, columns), found.median_px, rtol=1e-12)


@pytest.mark.parametrize("depth", [0.0, -1.0, 1e-300, np.nan, np.inf])
def test_where_nothing_projects_no_error_is_known(depth):
    camera = camera_of()
    _, parameters = covariance_of(camera, points(np.random.default_rng(0)), 0.5)
    assert np.isnan(expected_error_map(camera, parameters, 0.5, depth).error_px).all()
    assert np.isnan(expected_error_px(camera, parameters, 0.5, depth, grid_columns(camera)))


def test_parameters_without_effect_are_left_out():
    camera = camera_of(params=(1000.0, 800.0, 600.0, 0.1))
    xyz_cam = points(np.random.default_rng(0))
    columns, _ = covariance_of(camera, xyz_cam, 0.5)
    columns[7] = 0.0  # as if k had no effect
    without_k = parameter_covariance(columns, fitted_names(camera.model), 0.5)
    pinhole = camera_of(params=(1000.0, 800.0, 600.0, 0.1))
    found = expected_error_map(pinhole, without_k, 0.5, 6.0)
    assert len(without_k.names) == 7
    assert np.isfinite(found.error_px).all()


def test_an_unknown_covariance_gives_nan():
    camera = camera_of()
    _, parameters = covariance_of(camera, points(np.random.default_rng(0), 3), 0.5)
    assert np.isnan(expected_error_map(camera, parameters, 0.5, 6.0).median_px)
    assert np.isnan(median_depth(camera, np.empty((0, 3))))
