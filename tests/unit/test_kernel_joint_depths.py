"""Median depths of images in a joint system, compiled: numpy's to the last digits, and NaN where there are none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint import JointIndex
from sfm_audit.audit.kernels.joint_depths import median_depths
from sfm_audit.loaders.model import moved

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")
XYZ = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0], [1.0, 0.0, -2.0], [0.0, 0.0, 9.0]])


def index_of(counts, point_idx):
    """Each observation with its point, image by image."""
    point_idx = np.asarray(point_idx, dtype=np.int32)
    image = np.repeat(np.arange(len(counts)), counts).astype(np.int32)
    by_point = np.argsort(point_idx, kind="stable").astype(np.int32)
    ends = np.concatenate([[0], np.cumsum(np.bincount(point_idx, minlength=4))])
    return JointIndex(np.concatenate([[0], np.cumsum(counts)]), image, point_idx, by_point, ends)


def depths(index, images, xyz=XYZ, points=(0, 1, 2, 3)):
    num = index.num_images
    poses = np.tile([1.0, 0.0, 0.0, 0.0], (num, 1)), np.tile([5.0, 6.0, 0.5], (num, 1))
    return median_depths(index, np.asarray(images), np.asarray(points), xyz, poses)


def test_depths_are_numpys():
    spec = dataclasses.replace(SPEC, num_images=8, points_per_image=701)  # more than are put into order at once
    system = system_of(model_of(spec, seed=4))
    images = np.array([5, 0, 7, 5])
    found = system.median_depths(images)
    with numpy_only():
        assert_allclose(found, system.median_depths(images), rtol=1e-13)
    assert found[0] == found[3] == system.median_depth(5)


def test_odd_even_and_no_observations():
    index = index_of([3, 4, 0, 1], [1, 2, 0, 0, 1, 2, 3, 3])
    assert_array_equal(depths(index, [0, 1, 2, 3]), [1.5, 3.0, np.nan, 9.5])
    assert depths(index, np.zeros(0, dtype=np.int64)).size == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
def test_what_is_not_finite_is_as_in_numpy(value):
    index, xyz = index_of([3, 1], [1, 2, 0, 3]), XYZ.copy()
    xyz[1, 2] = value
    expected = np.median(moved(np.array([1.0, 0.0, 0.0, 0.0]), np.array([5.0, 6.0, 0.5]), xyz[:3])[:, 2])
    assert_array_equal(depths(index, [0, 1], xyz), [expected, 9.5])


def test_points_that_do_not_exist_are_left_to_numpy_and_images_are_an_error():
    index = index_of([3, 1], [1, 2, 0, 3])
    for points in ((0, 1, 2, 4), (0, 1, 2, -1)):
        assert depths(index, [0, 1], points=points) is None
    for images in ([2], [-1]):
        with pytest.raises(ValueError, match="images"):
            depths(index, images)
