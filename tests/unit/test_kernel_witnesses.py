"""What the compiled loops of the witnesses find is what numpy, SciPy and Python find."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fold_samples import NUM, ring_model
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels import witnesses as kernels
from sfm_audit.audit.witnesses.covisibility import Covisibility, covisibility, cuts_of
from sfm_audit.audit.witnesses.fold import find_fold, pair_sums
from sfm_audit.audit.witnesses.should_see import ShouldSee, should_see

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here")


def observed(rng, num_images, num_points, num_each):
    """Random observations, of which some are an image's second one of a point."""
    sizes = rng.integers(0, num_each + 1, num_images) if num_each else np.zeros(num_images, np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    return SimpleNamespace(offsets=offsets, point_idx=rng.integers(0, num_points, offsets[-1]))


@pytest.mark.parametrize(
    ("num_images", "num_points", "num_each"), [(1, 1, 0), (3, 1, 4), (2, 50, 30), (40, 30, 60), (300, 9, 20), (0, 4, 0)]
)
def test_points_and_pairs_of_images_are_those_of_sparse_products(num_images, num_points, num_each):
    residuals = observed(np.random.default_rng(num_each), num_images, num_points, num_each)
    with numpy_only():
        seen, pairs = covisibility(residuals, num_points)
    own_seen, own_pairs = covisibility(residuals, num_points)
    assert_array_equal(own_seen.offsets, seen.offsets)
    assert_array_equal(own_seen.image_idx, seen.image_idx)
    order = np.lexsort((pairs.second, pairs.first))
    for name in ("first", "second", "num_shared"):  # of 300 images more pairs than were expected
        assert_array_equal(getattr(own_pairs, name), getattr(pairs, name)[order], err_msg=name)


@pytest.mark.parametrize("seed", range(8))
def test_cuts_are_those_of_the_search_in_python(seed):
    rng = np.random.default_rng(seed)
    num = int(rng.integers(1, 40))
    ends = np.unique(np.sort(rng.integers(0, num, (int(rng.integers(0, 50)), 2)), axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    graph = Covisibility(ends[:, 0], ends[:, 1], np.ones(len(ends), np.int64), num)
    own = cuts_of(graph)
    with numpy_only():
        expected = cuts_of(graph)
    assert_array_equal(own.bridges, expected.bridges)
    assert_array_equal(own.articulation, expected.articulation)


def assert_same_looks(own, expected):
    assert (own.num_points, own.num_images) == (expected.num_points, expected.num_images)
    for name in ("point", "image", "sees"):
        assert_array_equal(getattr(own, name), getattr(expected, name), err_msg=name)
    for name in ("ray", "distance"):
        assert_allclose(getattr(own, name), getattr(expected, name), rtol=1e-14, atol=1e-14, err_msg=name)


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_who_should_see_a_point_and_what_pairs_share(scale):
    model = ring_model(0.5, num_points=1200)
    images = replace(
        model.images,
        translation_cam_from_world=model.images.translation_cam_from_world * scale,
        camera_idx=np.where(np.arange(NUM) == 7, -1, 0),  # one without a camera
    )
    model = replace(model, images=images, points=replace(model.points, xyz_world=model.points.xyz_world * scale))
    residuals = model_residuals(model)
    own = should_see(model, residuals)
    sums = pair_sums(own)
    fold = find_fold(own)
    with numpy_only():
        assert_same_looks(own, should_see(model, residuals))
        expected = pair_sums(own)
        theirs = find_fold(own)
    assert (own.image != 7).all()
    assert len(own.sees) > own.sees.sum() > 1000
    order = np.lexsort((sums.second, sums.first))
    assert_array_equal(sums.first[order], expected.first)
    assert_array_equal(sums.second[order], expected.second)
    for name in ("num", "both", "either", "cosine", "log_ratio", "rest"):
        assert_allclose(getattr(sums, name)[order], getattr(expected, name), rtol=1e-12, atol=1e-10, err_msg=name)
    assert_allclose(sums.own_rest, expected.own_rest, rtol=1e-12)
    assert_allclose([fold.score, fold.mixed], [theirs.score, theirs.mixed], rtol=1e-12)
    assert_array_equal(fold.group, theirs.group)


def test_numbers_that_are_none_are_seen_by_nobody():
    model = ring_model(0.0, num_points=300)
    odd = model.points.xyz_world.copy()
    odd[:4] = np.array([np.nan, np.inf, 1e300, 0.0])[:, None]
    poses = model.images.translation_cam_from_world.copy()
    poses[3] = np.nan
    poses[4] = 1e200
    model = replace(
        model,
        points=replace(model.points, xyz_world=odd),
        images=replace(model.images, translation_cam_from_world=poses),
    )
    with np.errstate(all="ignore"):
        residuals = model_residuals(model)
        own = should_see(model, residuals)
        with numpy_only():
            assert_same_looks(own, should_see(model, residuals))
    assert not np.isin(own.image, [3, 4]).any()


def test_pairs_of_no_views_and_of_views_out_of_order():
    empty = np.empty(0, np.int64)
    nothing = ShouldSee(5, 3, empty, empty, np.empty(0, np.bool_), np.empty((3, 0)), np.empty(0))
    assert len(pair_sums(nothing).first) == 0
    sees, ray = np.ones(2, dtype=np.bool_), np.ones((3, 2))
    given = np.zeros(2, np.int64), np.array([1, 0]), sees, (ray, np.zeros(2))
    assert kernels.pair_sums((1, 2), *given) is None  # left to numpy
    shuffled = ShouldSee(1, 2, *given[:3], ray, np.ones(2))
    assert pair_sums(shuffled).num.tolist() == [1.0]


def test_indices_out_of_range_are_left_to_numpy():
    offsets, points = np.array([0, 2]), np.array([0, 5])
    assert kernels.shared_points(offsets, points, 5) is None
    assert kernels.shared_points(np.array([0, 3]), points, 6) is None
    assert kernels.cuts(np.array([0]), np.array([2]), 2) is None
    assert (
        kernels.pair_sums((6, 1), points, np.array([0, -1]), np.ones(2, np.bool_), (np.ones((3, 2)), np.zeros(2)))
        is None
    )
    seen = np.zeros((3, 1)), np.array([0, 1]), np.array([1]), np.ones((3, 1)), np.ones(1)
    views = np.eye(3)[None], np.zeros((1, 3)), np.ones(1), np.ones((1, 2)), np.ones(1, np.bool_)
    assert kernels.should_see(seen, views, (0.5, 1.4, 0.9)) is None
