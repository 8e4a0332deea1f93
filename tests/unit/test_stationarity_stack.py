"""Pose offsets of small images, asked together, are those of each by itself."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sfm_audit.audit.inliers.stationarity import pose_offset_px, pose_offsets_px


def parts_of(num_points, num_images=6, seed=0):
    rng = np.random.default_rng(seed)
    sizes = ((2, num_points), (2, 3, num_points), (num_points, 3))
    return [tuple(rng.normal(size=size) for size in sizes) for _ in range(num_images)]


def assert_each_by_itself(parts):
    with np.errstate(all="ignore"):
        assert_array_equal(pose_offsets_px(parts), [pose_offset_px(*part) for part in parts])


@pytest.mark.parametrize("num_points", [0, 1, 2, 3, 4, 5, 9, 64])
def test_images_of_one_size_are_each_by_itself(num_points):
    assert_each_by_itself(parts_of(num_points))
    assert_each_by_itself(parts_of(num_points, num_images=1))


def test_a_pose_that_its_points_do_not_fix_is_left_to_its_image():
    parts = parts_of(5)
    for _, jacobian, xyz_cam in parts[2:4]:
        jacobian[:, :, 1:], xyz_cam[1:] = jacobian[:, :, :1], xyz_cam[:1] * (1.0 + 1e-9)
    assert_each_by_itself(parts)


@pytest.mark.parametrize("spoilt", [0.0, np.nan, np.inf, 1e200])
def test_odd_derivatives_are_left_to_each_image(spoilt):
    parts = parts_of(7)
    parts[1][1][:, 2] = spoilt
    assert_each_by_itself(parts)
