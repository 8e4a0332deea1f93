"""Whitening and leave-one-out sums against dense linear algebra, track by track (method.md (2), (3))."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from sfm_audit.audit.noise.fits import fit_variance
from sfm_audit.audit.noise.tracks import track_statistics


def random_tracks(rng, lengths, scale=1.0):
    """Jacobians (2, 3, n), residuals (2, n) and track of each observation, observations in random order."""
    point_idx = np.repeat(np.arange(len(lengths)), lengths)
    point_idx = rng.permutation(point_idx)
    jacobian = rng.normal(size=(2, 3, point_idx.size)) * 100.0 * scale
    return jacobian, rng.normal(size=(2, point_idx.size)), point_idx


def slow_reference(jacobian, residuals, point_idx):
    """e, sum of squares without each observation, and rank, by QR and eigenvectors."""
    whitened, other, rank = np.full_like(residuals, np.nan), np.full(point_idx.size, np.nan), {}
    for point in np.unique(point_idx):
        rows = np.flatnonzero(point_idx == point)
        stacked = jacobian[:, :, rows].transpose(2, 0, 1).reshape(-1, 3)
        eps = residuals[:, rows].T.reshape(-1)
        left, singular, _ = np.linalg.svd(stacked, full_matrices=False)
        basis = left[:, singular > 1e-9 * singular[0]]
        rank[point] = basis.shape[1]
        eps = eps - basis @ (basis.T @ eps)
        for k, row in enumerate(rows):
            own = slice(2 * k, 2 * k + 2)
            values, vectors = np.linalg.eigh(np.eye(2) - basis[own] @ basis[own].T)
            if values[0] < 0.05 or len(rows) < 3:
                continue
            whitened[:, row] = vectors @ np.diag(values**-0.5) @ vectors.T @ eps[own]
            other[row] = eps @ eps - whitened[:, row] @ whitened[:, row]
    return whitened, other, rank


@pytest.mark.parametrize("seed", range(5))
def test_equals_dense_linear_algebra(seed):
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 12, 60)
    jacobian, residuals, point_idx = random_tracks(rng, lengths)
    found = track_statistics(residuals, jacobian, point_idx, len(lengths))
    whitened, other, _ = slow_reference(jacobian, residuals, point_idx)
    assert_allclose(found.whitened_px, whitened, atol=1e-10)
    assert_allclose(found.other_sq_px2, other, atol=1e-9)
    assert found.verified.sum() > 100
    assert (found.track_length == np.array(lengths)[point_idx]).all()


def test_low_parallax_tracks_lose_a_degree_of_freedom():
    rng = np.random.default_rng(1)
    jacobian, residuals, point_idx = random_tracks(rng, [6] * 20)
    direction = rng.normal(size=(3, 20))
    direction /= np.linalg.norm(direction, axis=0)
    along = direction[:, point_idx]
    jacobian -= np.einsum("ijn,jn->in", jacobian, along)[:, None] * along  # nobody sees the point move along it
    found = track_statistics(residuals, jacobian, point_idx, 20)
    whitened, other, rank = slow_reference(jacobian, residuals, point_idx)
    assert set(rank.values()) == {2}
    assert (found.other_dof == 2 * 6 - 2 - 2).all()
    assert_allclose(found.whitened_px, whitened, atol=1e-8)
    assert_allclose(found.other_sq_px2, other, atol=1e-7)


def test_sum_of_squares_without_k_is_that_of_a_refit_without_k():
    """(3) is exact: leaving k out and fitting the point again gives the same sum of squares (numpy's lstsq)."""
    rng = np.random.default_rng(2)
    jacobian, residuals, point_idx = random_tracks(rng, [5])
    found = track_statistics(residuals, jacobian, point_idx, 1)
    for k in range(5):
        rest = np.arange(5) != k
        stacked = jacobian[:, :, rest].transpose(2, 0, 1).reshape(-1, 3)
        _, sum_of_squares, _, _ = np.linalg.lstsq(stacked, residuals[:, rest].T.reshape(-1), rcond=None)
        assert_allclose(found.other_sq_px2[k], sum_of_squares[0], rtol=1e-9)


def test_whitened_residuals_have_the_noise_of_the_detector():
    """Noise 0.5 px, points fitted to it: raw sd / sigma = sqrt(1 - 3 / 2L), whitened sd = sigma."""
    rng = np.random.default_rng(3)
    length, num_points, sigma = 4, 20_000, 0.5
    jacobian, noise, point_idx = random_tracks(rng, [length] * num_points)
    fitted = track_statistics(sigma * noise, jacobian, point_idx, num_points)
    share = fitted.removable_sq_px2 / fitted.total_sq_px2
    assert share == pytest.approx(3 / (2 * length), rel=0.01)
    assert np.nanstd(fitted.whitened_px) == pytest.approx(sigma, rel=0.01)
    assert_allclose(np.nanmean(fitted.other_sq_px2 / fitted.other_dof), sigma**2, rtol=0.02)


def test_the_rest_of_the_track_does_not_contain_the_observation():
    """Under Gaussian noise a_k^2 of (3) is independent of e_k; the mean of the others' |e_j|^2 is not (the trap)."""
    rng = np.random.default_rng(4)
    length, num_points = 3, 30_000
    jacobian, noise, point_idx = random_tracks(rng, [length] * num_points)
    found = track_statistics(noise, jacobian, point_idx, num_points)
    used = found.verified
    sq = (found.whitened_px**2).sum(axis=0)
    total = np.bincount(point_idx[used], weights=sq[used], minlength=num_points)
    count = np.bincount(point_idx[used], minlength=num_points)
    several = used & (count[point_idx] == length)
    naive = (total[point_idx] - sq)[several] / (length - 1)
    exact = (found.other_sq_px2 / found.other_dof)[several]

    def correlation(a, b):
        return np.corrcoef(np.argsort(np.argsort(a)), np.argsort(np.argsort(b)))[0, 1]

    assert abs(correlation(exact, sq[several])) < 0.02
    assert correlation(naive, sq[several]) > 0.1


@given(seed=st.integers(0, 1000), gain=st.sampled_from([0.25, 2.0, 8.0]))
def test_whitening_ignores_the_unit_of_the_world(seed, gain):
    rng = np.random.default_rng(seed)
    jacobian, residuals, point_idx = random_tracks(rng, [3, 5, 2, 9])
    one = track_statistics(residuals, jacobian, point_idx, 4)
    other = track_statistics(residuals, jacobian * gain, point_idx, 4)
    assert_allclose(other.whitened_px, one.whitened_px, rtol=1e-12)
    assert (other.other_dof == one.other_dof).all()


def test_homoscedastic_noise_is_not_explained_by_the_rest_of_the_track():
    """(1) with a_k^2 of (3): sigma_l^2 ~ 0 under homoscedastic noise; the naive mean gives 0.2 and more."""
    rng = np.random.default_rng(5)
    length, num_points = 4, 20_000
    jacobian, noise, point_idx = random_tracks(rng, [length] * num_points)
    found = track_statistics(noise, jacobian, point_idx, num_points)
    sq = (found.whitened_px**2).sum(axis=0)
    used = found.verified & (np.bincount(point_idx[found.verified], minlength=num_points)[point_idx] == length)
    total = np.bincount(point_idx[used], weights=sq[used], minlength=num_points)
    exact = found.other_sq_px2[used] / found.other_dof[used]
    naive = (total[point_idx[used]] - sq[used]) / (2 * (length - 1))
    y = found.whitened_px[:, used] ** 2
    assert fit_variance(y, np.minimum(exact, np.percentile(exact, 99))).structure < 0.02
    assert fit_variance(y, np.minimum(naive, np.percentile(naive, 99))).structure > 0.2
