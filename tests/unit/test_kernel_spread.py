"""Hull, cells and median depth from the compiled kernel are those of numpy, SciPy and Python."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull

from sfm_audit.audit.camera_quality.coverage import cells_of, hull_area_px2
from sfm_audit.audit.camera_quality.expected_error import medians_of
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.spread import Inliers, image_spread
from sfm_audit.loaders.model import moved

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here")
SIZE = (1600.0, 1200.0)


def inliers_of(parts, rng=None):
    """Images with these points each (n, 2); observations and 3D points lie in other orders in their tables."""
    rng = rng or np.random.default_rng(0)
    sizes = [len(part) for part in parts]
    num, num_images = sum(sizes), len(parts)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    row, point = rng.permutation(num), rng.integers(0, num + 1, num)
    xy_px = np.empty((num, 2))
    xy_px[row] = np.concatenate([np.reshape(part, (-1, 2)) for part in parts])
    poses = rng.normal(size=(num_images, 4)), rng.normal(size=(num_images, 3))
    return Inliers(offsets, row, point, xy_px, rng.normal(size=(num + 1, 3)) * 5, *poses)


def found_of(parts, grid=8, size=SIZE):
    inliers = inliers_of(parts)
    return inliers, image_spread(inliers, np.arange(len(parts)), np.tile(size, (len(parts), 1)), grid)


@given(seed=st.integers(0, 10_000), n=st.integers(3, 300), kind=st.sampled_from(["normal", "whole", "circle", "far"]))
def test_hulls_are_those_of_scipy(seed, n, kind):
    rng = np.random.default_rng(seed)
    xy = rng.normal(size=(n, 2)) * [300, 200] + 500
    if kind == "whole":  # many ties in every direction
        xy = np.round(xy / 100)
        xy[:3] = [0, 0], [0, 1], [1, 0]
    elif kind == "circle":  # nothing can be left out
        xy /= np.linalg.norm(xy, axis=1, keepdims=True)
    elif kind == "far":
        xy = xy * 1e-3 + 1e4
    _, lie = found_of([xy])
    assert lie.hull_px2[0] == pytest.approx(ConvexHull(xy).volume, rel=1e-6 if kind == "far" else 1e-9)
    assert lie.hull_px2[0] == pytest.approx(hull_area_px2(xy), rel=1e-9)


def test_all_of_it_is_that_of_numpy():
    rng = np.random.default_rng(4)
    sizes = [0, 1, 2, 3, 4, 5, 12, 13, 63, 64, 65, 500, 0, 2001]
    parts = [rng.normal(0.5, 0.3, (n, 2)) * SIZE for n in sizes]
    inliers, lie = found_of(parts)
    size_px = np.tile(SIZE, (len(parts), 1))
    points = np.concatenate(parts)
    assert_array_equal(lie.occupied_cells, cells_of(points, inliers.offsets, size_px, 8))
    assert_allclose(lie.hull_px2, [hull_area_px2(part) for part in parts], rtol=1e-12)
    for k, (first, last) in enumerate(pairwise(inliers.offsets.tolist())):
        xyz = inliers.xyz_world[inliers.point_idx[first:last]]
        depth = moved(inliers.quaternions[k], inliers.translations[k], xyz)[:, 2]
        assert_array_equal(lie.median_depth[k], np.median(depth) if len(depth) else np.nan)
    depth = moved(*(np.repeat(each, sizes, axis=0).T for each in inliers[5:]), inliers.xyz_world[inliers.point_idx])
    assert_array_equal(lie.median_depth, medians_of(depth[:, 2], inliers.offsets))
    chosen = np.array([13, 3, 13])
    again = image_spread(inliers, chosen, size_px[chosen], 8)
    for own, of_all in zip(again, lie, strict=True):
        assert_array_equal(own, of_all[chosen])


def test_points_of_no_area_and_images_of_no_size():
    line = np.linspace([0, 0], [100, 50], 40)
    _, lie = found_of([line, np.tile([[3.0, 4.0]], (50, 1)), line[::-1] / 3.0, np.array([[1.0, 2.0], [3.0, 5.0]])])
    assert_array_equal(lie.hull_px2, 0.0)
    square = np.array([[0.0, 0], [1600, 0], [1600, 1200], [0, 1200], [800, 600]])
    inliers = inliers_of([square] * 3)
    sizes = np.array([SIZE, (0.0, 1200.0), (1600.0, np.nan)])
    lie = image_spread(inliers, np.arange(3), sizes, 4)
    assert_allclose(lie.hull_px2, 1600 * 1200)
    assert lie.occupied_cells.tolist() == [2, 0, 0]  # three corners are the next pixel's


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, 1e300, -1e308, 5e-324])
def test_odd_numbers_reach_their_own_image_alone(odd):
    rng = np.random.default_rng(2)
    parts = [rng.normal(0.5, 0.3, (40, 2)) * SIZE for _ in range(3)]
    _, clean = found_of(parts)
    for rows in (slice(3, 4), slice(0, 39), slice(None)):
        spoilt = [part.copy() for part in parts]
        spoilt[1][rows, 0] = odd
        _, lie = found_of(spoilt)
        for own, expected in zip(lie, clean, strict=True):
            assert_array_equal(own[[0, 2]], expected[[0, 2]])
        assert 0 <= lie.occupied_cells[1] <= clean.occupied_cells[1]


def test_rows_out_of_range_are_an_error_and_numpy_is_asked_on_demand():
    good = inliers_of([np.ones((3, 2)), np.ones((2, 2))])
    size = np.ones((2, 2))
    for name, value in (
        ("observation_row", np.array([0, 1, 2, 3, 5])),
        ("point_idx", np.array([0, 1, -1, 3, 4])),
        ("offsets", np.array([0, 3, 6])),
        ("offsets", np.array([0, 3, 2])),
        ("quaternions", np.ones((1, 4))),
    ):
        with pytest.raises(IndexError):
            image_spread(good._replace(**{name: value}), np.arange(2), size, 8)
    with numpy_only():
        assert image_spread(good, np.arange(2), size, 8) is None
