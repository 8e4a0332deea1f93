"""Tracks whitened by the compiled kernels are those of numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.tracks import PriorGroups, sums, track_others
from sfm_audit.audit.noise.others import ByRow
from sfm_audit.audit.noise.prior import _sums, _sums_of, fit_track_prior
from sfm_audit.audit.noise.tracks import track_statistics

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")
NAMES = ("whitened_px", "verified", "track_length", "other_sq_px2", "other_dof", "removable_sq_px2", "total_sq_px2")


def random_tracks(rng, lengths, scale=1.0):
    """Jacobians (2, 3, n), residuals (2, n) and track of each observation, observations in random order."""
    point_idx = rng.permutation(np.repeat(np.arange(len(lengths)), lengths))
    return rng.normal(size=(2, 3, point_idx.size)) * 100.0 * scale, rng.normal(size=(2, point_idx.size)), point_idx


def both(residuals, jacobian, point_idx, num_points, **options):
    with numpy_only():
        expected = track_statistics(residuals, jacobian, point_idx, num_points, **options)
    return track_statistics(residuals, jacobian, point_idx, num_points, **options), expected


def assert_same(found, expected):
    for name in NAMES:
        value = getattr(expected, name)
        scale = np.nanmax(np.abs(np.where(np.isfinite(value), value, 0.0)), initial=0.0)
        assert_allclose(getattr(found, name), value, rtol=1e-9, atol=1e-12 * scale, err_msg=name)
        assert getattr(found, name).dtype == value.dtype if isinstance(value, np.ndarray) else True


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9, 1e-90])
@pytest.mark.parametrize("leave_out", [False, True])
def test_random_tracks(scale, leave_out):
    rng = np.random.default_rng(3)
    lengths = rng.integers(0, 12, 300)
    jacobian, residuals, point_idx = random_tracks(rng, lengths, scale)
    left_out = rng.random(point_idx.size) < 0.2 if leave_out else None
    found, expected = both(residuals, jacobian, point_idx, len(lengths) + 3, left_out=left_out)
    assert_same(found, expected)
    assert found.verified.sum() > 500


def test_points_that_are_not_determined():
    rng = np.random.default_rng(4)
    jacobian, residuals, point_idx = random_tracks(rng, [6] * 40)
    direction = rng.normal(size=(3, 40))
    direction /= np.linalg.norm(direction, axis=0)
    along = direction[:, point_idx]
    share = rng.choice([0.0, 1e-7, 1e-2], 40)[point_idx]  # of what moves the point along: none, too little, enough
    jacobian -= (1.0 - share) * np.einsum("ijn,jn->in", jacobian, along)[:, None] * along
    jacobian[:, :, point_idx == 7] = 0.0
    found, expected = both(residuals, jacobian, point_idx, 40)
    assert_same(found, expected)
    assert set((2 * 6 - 2 - found.other_dof).tolist()) == {0, 2, 3}


def test_odd_numbers_are_those_of_numpy():
    rng = np.random.default_rng(5)
    jacobian, residuals, point_idx = random_tracks(rng, [5] * 30)
    jacobian[0, 1, :9], jacobian[1, 2, 9:15] = math.nan, math.inf
    residuals[0, 40], residuals[1, 50] = math.nan, 1e160
    with np.errstate(all="ignore"):
        assert_same(*both(residuals, jacobian, point_idx, 30))


@pytest.mark.parametrize("lengths", [[], [0, 0], [1], [2, 1], [4]])
def test_hardly_any(lengths):
    jacobian, residuals, point_idx = random_tracks(np.random.default_rng(6), np.array(lengths, dtype=np.int64))
    assert_same(*both(residuals, jacobian, point_idx, len(lengths)))


@pytest.mark.parametrize("row", [-1, 3])
def test_a_point_that_is_not_there_is_no_memory(row):
    jacobian, residuals, point_idx = random_tracks(np.random.default_rng(6), [3, 3, 3])
    point_idx[4] = row
    with pytest.raises(IndexError, match="beyond the 3"):
        sums(residuals, jacobian, point_idx, np.ones(9, dtype=np.bool_), 3)
    with pytest.raises(ValueError, match="one size"):
        sums(residuals[:, 1:], jacobian, point_idx, np.ones(9, dtype=np.bool_), 3)


@pytest.mark.parametrize("leave_out", [False, True])
def test_others_of_some_rows(leave_out):
    rng = np.random.default_rng(9)
    jacobian, residuals, point_idx = random_tracks(rng, rng.integers(1, 9, 60))
    left_out = point_idx % 5 == 1 if leave_out else None
    found, expected = both(residuals, jacobian, point_idx, 60, left_out=left_out)
    rows = rng.integers(0, point_idx.size, 40)
    for asked in (slice(7, 90), slice(90, 91), slice(5, 5), slice(250, None), rows, rows.reshape(8, 5)):
        of_found, of_expected = found.others.of(asked), expected.others.of(asked)
        for some, others in zip(of_found, of_expected, strict=True):
            assert_allclose(some, others, rtol=1e-9, atol=1e-12)
        with numpy_only():
            assert all(map(np.array_equal, found.others.of(asked), of_found, (True, False)))
    assert found.others.lengths(slice(7, 90)).tolist() == expected.track_length[7:90].tolist()
    assert not leave_out or (found.other_dof[left_out] > expected.other_dof.min()).any()


def test_others_of_a_track_that_is_not_there_are_no_memory():
    sq, dof, point_idx = np.ones(2), np.ones(2, dtype=np.int32), np.array([0, 1, 2], dtype=np.int32)
    rows = point_idx, np.ones((2, 3)), np.ones(3, dtype=np.bool_)
    assert track_others((sq, dof), rows, range(2)) is not None
    for tracks in ((sq, dof), (np.ones(3), dof), (np.ones(3), np.ones(4, dtype=np.int32))):
        with pytest.raises(IndexError, match="beyond the"):
            track_others(tracks, rows, range(3))
    with pytest.raises(ValueError, match="one size"):
        track_others((np.ones(3), np.ones(3, dtype=np.int32)), (point_idx, np.ones((2, 4)), rows[2]), range(3))


def test_groups_of_arrays_of_other_sizes_are_no_memory():
    sq, dof = np.ones(70_000), np.ones(70_000, dtype=np.int32)
    groups = PriorGroups.of(sq, ByRow(sq, dof, dof))
    assert groups.counts.tolist() == [70_000]
    assert groups.sums_of_squares() == (70_000.0, 70_000.0)
    for size in (1, 69_999):
        with pytest.raises(ValueError, match="one size"):
            PriorGroups.of(sq, ByRow(sq[:size], dof, dof))
    with pytest.raises(ValueError, match="one size"):
        PriorGroups.of(sq, ByRow(sq, dof, dof), np.ones(7, dtype=np.bool_))
    with pytest.raises(ValueError, match="one size"):
        PriorGroups.of(sq, ByRow(sq, dof[1:], dof))
    with pytest.raises(ValueError, match="negative"):
        PriorGroups.of(sq, ByRow(sq, -dof, dof))


@pytest.mark.parametrize("num", [1, 3, 4, 5, 1023, 1024, 9001])
@pytest.mark.parametrize("scale", [1e-100, 1.0, 1e100])
def test_sums_of_the_likelihood(num, scale):
    rng = np.random.default_rng(num)
    sq, other, dof = scale * rng.chisquare(2, num), scale * rng.chisquare(5, num), rng.choice([1, 3, 4, 19], num)
    sq[rng.random(num) < 0.1] = 0.0
    assert PriorGroups.of(sq, ByRow(other, dof, dof)) is not None
    for nu0, prior_sq in ((0.1, 1e-3 * scale), (3.0, scale), (1e4, 1e5 * scale)):
        expected = _sums(nu0, prior_sq, sq, other, dof.astype(np.float64))
        rounding = 1e-15 * num * (1.0 + abs(math.log(prior_sq)))  # of numpy, which subtracts two large logarithms
        assert_allclose(_sums_of(sq, other, dof)(nu0, prior_sq)[:2], expected[:2], rtol=1e-10, atol=rounding)
        assert_allclose(_sums_of(sq, other, dof)(nu0, prior_sq)[2:], expected[2:], rtol=1e-10)


def test_priors_are_the_same():
    rng = np.random.default_rng(8)
    variance = 6.0 / rng.chisquare(6, 50_000)
    dof = rng.integers(1, 20, variance.size)
    sq, other = variance * rng.chisquare(2, variance.size), variance * rng.chisquare(dof)
    found = fit_track_prior(sq, other, dof)
    with numpy_only():
        expected = fit_track_prior(sq, other, dof)
    assert_allclose([found.nu0, found.s0_px], [expected.nu0, expected.s0_px], rtol=1e-9)
    assert found.converged
    assert expected.converged
