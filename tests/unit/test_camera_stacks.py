"""Cameras asked together say what each says by itself, to the last bit: nothing depends on who was asked with whom."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sfm_audit.audit.camera_quality.coverage import spread_of
from sfm_audit.audit.camera_quality.expected_error import grid_columns, grid_rays
from sfm_audit.audit.camera_quality.identifiability import ParameterCovariance, fitted_names
from sfm_audit.audit.camera_quality.measure import CameraShape, expected_errors_px
from sfm_audit.audit.camera_quality.plausibility import camera_plausibility, folds_over
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord

NUM = 9


def cameras_of(name: str) -> list[CameraRecord]:
    """Cameras of one model: some fold, one has no distortion, one no size."""
    model, rng = BY_NAME[name], np.random.default_rng(3)
    out = []
    for k in range(NUM):
        width, height = (0, 800) if k == NUM - 1 else rng.integers(300, 4000, 2).tolist()
        params = np.array([width, height], dtype=np.float64) if model.is_spherical else np.zeros(model.num_params)
        params[list(model.focal_idxs)] = rng.uniform(0.4, 1.5) * max(width, height)
        if not model.is_spherical:
            params[list(model.principal_point_idxs)] = rng.uniform(0.3, 0.7, 2) * (width, height)
            params[list(model.extra_idxs)] = rng.normal(0.0, (0.0, 0.02, 0.3)[k % 3], len(model.extra_idxs))
        out.append(CameraRecord(k + 1, model, width, height, params))
    return out


@pytest.mark.parametrize("name", BY_NAME)
def test_shapes_and_errors_of_many_are_those_of_each(name):
    cameras = cameras_of(name)
    shapes = CameraShape.of_all(cameras)
    usable = [shape for shape in shapes if shape is not None]
    assert len(usable) >= NUM - 1
    size = len(fitted_names(cameras[0].model))
    root = np.random.default_rng(0).normal(size=(len(usable), size, size)) * 1e-3
    known = [ParameterCovariance(fitted_names(cameras[0].model), each @ each.T, 1.0) for each in root]
    sigma_px, depth = np.linspace(0.4, 0.9, len(usable)), np.linspace(2.0, 9.0, len(usable))
    errors = expected_errors_px(usable, known, sigma_px, depth)
    twice = expected_errors_px([*usable, *usable], [*known, *known], np.tile(sigma_px, 2), np.tile(depth, 2))
    assert_array_equal(twice, np.tile(errors, 2))  # of which each camera has two images
    for k, shape in enumerate(usable):
        camera = shape.camera
        assert repr(shape.plausibility) == repr(camera_plausibility(camera))
        assert_array_equal(shape.rays, grid_rays(camera))
        assert_array_equal(errors[k], shape.expected_error_px(known[k], float(sigma_px[k]), float(depth[k])))
        assert grid_columns(camera).shape == (size, 2, 256)
    assert np.isfinite(errors).sum() >= 3


def test_some_fold_and_some_do_not():
    folds = {name: sum(map(folds_over, cameras_of(name))) for name in ("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")}
    assert all(0 < num < NUM - 1 for num in folds.values()), folds


def test_errors_of_what_is_not_known_are_nan_and_of_fewer_parameters_as_alone():
    shape = CameraShape.of(cameras_of("RADIAL")[1])
    names = fitted_names(shape.camera.model)
    full, fewer = (ParameterCovariance(n, np.eye(len(n)) * 1e-6, 1.0) for n in (names, names[:-1]))
    singular = ParameterCovariance(names, np.full((len(names),) * 2, np.nan), 0.0)
    given = [full, fewer, singular, full, ParameterCovariance((), np.empty((0, 0)), np.nan)]
    sigma_px = np.array([0.5, 0.5, 0.5, np.nan, 0.5])
    found = expected_errors_px([shape] * 5, given, sigma_px, np.full(5, 4.0))
    alone = [shape.expected_error_px(own, 0.5, 4.0) for own in (full, fewer)]
    assert_array_equal(found[:2], alone)
    assert np.isfinite(found[:2]).all()
    assert np.isnan(found[2:]).all()


def test_images_together_are_covered_as_each_by_itself():
    rng = np.random.default_rng(1)
    sizes = [40, 0, 3, 13, 1, 200]
    cameras = cameras_of("PINHOLE")[-len(sizes) :]
    xy_px = np.concatenate(
        [rng.normal(0.5, 0.3, (n, 2)) * (camera.width, camera.height) for n, camera in zip(sizes, cameras, strict=True)]
    )
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    together = spread_of(xy_px, offsets, cameras, 8)
    for k, camera in enumerate(cameras):
        alone = spread_of(xy_px[offsets[k] : offsets[k + 1]], np.array([0, sizes[k]]), [camera], 8)
        assert_array_equal([each[k] for each in together], [each[0] for each in alone])
    assert together.occupied_cells[:5].max() > 10
    assert np.isnan(together.coverage[5])  # of an image without an area
    assert together.occupied_cells[5] == 0
