"""Derivatives are compared in units of the median distance of an image's points."""

from __future__ import annotations

import numpy as np
import pytest

from sfm_audit.audit.inliers.sanity import MAX_MAGNITUDE, is_differentiable


@pytest.mark.parametrize("num_points", [1, 2, 3, 8, 999, 1000, 1001, 1002])
def test_the_median_distance_is_the_unit_of_derivatives(num_points):
    xyz_cam = np.random.default_rng(num_points).uniform(1.0, 9.0, size=(num_points, 3))
    limit = MAX_MAGNITUDE / np.median(np.abs(xyz_cam).max(axis=1))
    assert is_differentiable(np.full((2, 3, num_points), limit * (1.0 - 1e-12)), xyz_cam).all()
    assert not is_differentiable(np.full((2, 3, num_points), limit * (1.0 + 1e-12)), xyz_cam).any()


@pytest.mark.parametrize("num_points", [3, 1001])
def test_without_a_median_distance_nothing_is_differentiable(num_points):
    xyz_cam = np.ones((num_points, 3))
    xyz_cam[1, 1] = np.nan
    assert not is_differentiable(np.ones((2, 3, num_points)), xyz_cam).any()
