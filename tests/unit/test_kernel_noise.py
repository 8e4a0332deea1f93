"""The noise of images by the compiled kernel is that of numpy."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels import noise as kernel
from sfm_audit.audit.noise import stack
from sfm_audit.audit.noise.fits import CONSISTENCY, fit_constant_variance
from sfm_audit.audit.noise.others import ByRow
from sfm_audit.audit.noise.predictive import TrackStandardiser, predict
from sfm_audit.audit.noise.prior import TrackPrior
from sfm_audit.audit.noise.standardise import ModelTracks, constant_noise, track_noise
from sfm_audit.audit.noise.tracks import TrackStatistics

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")
SIZES = (0, 1, 2, 3, 4, 5, 9, 63, 64, 65, 255, 256, 257, 700, 2100)


def tracks_of(rng, sizes, prior, *, spread=1.0, hidden=0.1):
    """Tracks of images of these sizes, drawn from the prior; ``hidden`` of the observations are not verified."""
    n = sum(sizes)
    dof = rng.choice([1, 3, 5, 7, 21], n).astype(np.int32)
    variance = prior.s0_px**2 * prior.nu0 / rng.chisquare(prior.nu0, n)
    verified = rng.random(n) >= hidden
    whitened = np.where(verified, spread * np.sqrt(variance) * rng.standard_normal((2, n)), np.nan)
    other = np.where(verified, variance * rng.chisquare(dof), np.nan)
    statistics = TrackStatistics(whitened, verified, ByRow(other, dof, dof), 0.0, 1.0)
    return model_of_tracks(statistics, sizes, prior)


def model_of_tracks(statistics, sizes, prior):
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    verified = statistics.verified
    standardiser = TrackStandardiser.build(predict(prior, statistics.others, verified.size, verified))
    before = np.concatenate([[0], np.cumsum(verified)])
    nobody = np.zeros(len(sizes), dtype=np.bool_)
    return ModelTracks(statistics, nobody, False, offsets, before[offsets], prior, standardiser)


def assert_same(tracks, least):
    """Compare all images; at least so many by the kernel."""
    images = range(len(tracks.offsets) - 1)
    found = stack.track_noises(tracks, images, dict.fromkeys(images, 0.5))
    for image, noise in found.items():
        expected = track_noise(tracks, image, 0.5)
        for name, value in dataclasses.asdict(expected).items():
            scale = 1e-11 * (1.0 + np.abs(value)) if name == "z" else 1e-300
            assert np.shape(getattr(noise, name)) == np.shape(value)
            difference = np.abs(np.asarray(getattr(noise, name), dtype=np.float64) - value)
            same = np.isnan(getattr(noise, name)) & np.isnan(value)
            assert (same | (difference <= np.maximum(scale, 1e-10 * np.abs(value)))).all(), (name, image)
    assert len(found) >= least
    return found


@pytest.mark.parametrize("prior", [TrackPrior(4.0, 0.5, True), TrackPrior(0.1, 1e-6, True), TrackPrior(1e4, 1e5, True)])
@pytest.mark.parametrize("spread", [1.0, 0.2, 40.0])
def test_images_of_all_sizes(prior, spread):
    tracks = tracks_of(np.random.default_rng(5), SIZES, prior, spread=spread)
    found = assert_same(tracks, len(SIZES) - 3)
    assert min(noise.scale_ratio for noise in found.values()) > 0.0


@pytest.mark.parametrize("kind", ["structure", "no_structure", "proportional", "one_length", "outliers"])
def test_every_way_to_fit_the_papers_variances(kind):
    rng = np.random.default_rng(11)
    sizes, prior = [400] * 12, TrackPrior(8.0, 0.7, True)
    tracks = tracks_of(rng, sizes, prior, hidden=0.0)
    a_sq = rng.uniform(0.01, 4.0, 4800) if kind != "one_length" else np.full(4800, 1.3)
    variance = {"structure": 0.3 + 0.6 * a_sq, "proportional": 0.8 * a_sq}.get(kind, 0.5 + 0.0 * a_sq)
    e = np.sqrt(variance) * rng.standard_normal((2, 4800))
    if kind == "outliers":
        e[:, rng.random(4800) < 0.2] *= 500.0
    others = dataclasses.replace(tracks.statistics.others, sq_px2=a_sq * tracks.statistics.other_dof)
    statistics = dataclasses.replace(tracks.statistics, whitened_px=e, others=others)
    found = assert_same(model_of_tracks(statistics, sizes, prior), 12)
    zero = {(noise.sigma_d_px == 0.0, noise.sigma_l == 0.0) for noise in found.values()}
    expected = {"structure": (False, False), "proportional": (True, False), "one_length": (False, True)}
    assert expected.get(kind, (False, True)) in zero


def test_what_lies_far_out_is_transformed_exactly():
    tracks = tracks_of(np.random.default_rng(6), [900], TrackPrior(6.0, 0.5, True), hidden=0.0)
    for factor in (30.0, 1e4, 1e30):
        statistics = dataclasses.replace(tracks.statistics, whitened_px=tracks.statistics.whitened_px.copy())
        statistics.whitened_px[:, ::97] *= factor
        found = assert_same(dataclasses.replace(tracks, statistics=statistics), 1)
        assert np.abs(found[0].z).max() > 6.0


def test_odd_numbers_are_left_to_numpy():
    tracks = tracks_of(np.random.default_rng(7), [50] * 8, TrackPrior(6.0, 0.5, True), hidden=0.0)
    e, other = tracks.statistics.whitened_px.copy(), tracks.statistics.other_sq_px2.copy()
    e[0, 10], e[:, 50:100], e[1, 120], other[170] = math.nan, 0.0, math.inf, math.inf
    e[:, 200:245], e[:, 250:300], other[320] = 0.0, 1e200 * e[:, 250:300], math.nan
    others = dataclasses.replace(tracks.statistics.others, sq_px2=other)
    statistics = dataclasses.replace(tracks.statistics, whitened_px=e, others=others)
    found = stack.track_noises(
        dataclasses.replace(tracks, statistics=statistics), range(8), dict.fromkeys(range(8), 0.5)
    )
    assert 7 in found
    assert not {0, 1, 2, 4, 6} & set(found)


def test_constant_noise_of_images():
    rng = np.random.default_rng(8)
    auditor = ModelAuditor(model_of(dataclasses.replace(SPEC, num_images=6, points_per_image=40), seed=5))
    r = auditor.residuals
    for scale in (1e-9, 1.0, 1e60):
        residuals = dataclasses.replace(r, residuals_px=scale * rng.standard_cauchy(r.residuals_px.shape))
        residuals.residuals_px[:, residuals.rows(1)] = 0.0
        residuals.residuals_px[0, residuals.rows(2).start] = math.nan
        residuals.residuals_px[:, residuals.rows(3)][:, 3:] = 0.0
        fits = stack.constant_fits(residuals)
        assert np.isfinite(fits.sigma_px).tolist() == [True, False, False, False, True, True]
        found = stack.constant_noises(residuals, range(1, 6), fits)
        for image, noise in enumerate(found, start=1):
            expected = constant_noise(residuals.residuals_px[:, residuals.rows(image)])
            assert_allclose(noise.sigma_constant_px, expected.sigma_constant_px, rtol=1e-12)
            assert_allclose(noise.z, expected.z, rtol=1e-12)
            assert noise.converged == expected.converged
        with numpy_only():
            assert_allclose(fits.sigma_px, stack.constant_fits(residuals).sigma_px, rtol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 8, 1001])
def test_constant_variances_of_all_sizes(size):
    y = np.random.default_rng(size).standard_t(2.0, (2, 5 * size))
    found = kernel.constant_variances(y, np.arange(6) * size, CONSISTENCY)
    expected = [fit_constant_variance(y[:, k * size : (k + 1) * size] ** 2).detector_px2 for k in range(5)]
    assert_allclose(found, expected, rtol=1e-12)


def test_memory_is_not_left():
    y = np.ones((2, 10))
    for offsets in ([0, 11], [-1, 3], [0, 6, 5]):
        with pytest.raises(IndexError, match="10 columns"):
            kernel.constant_variances(y, np.array(offsets), CONSISTENCY)
    tracks = tracks_of(np.random.default_rng(7), [50], TrackPrior(6.0, 0.5, True), hidden=0.0)
    statistics, standardiser = tracks.statistics, tracks.standardiser
    given = statistics.whitened_px, statistics.verified, statistics.other_sq_px2
    dof = standardiser.prediction.dof_values
    with pytest.raises(IndexError, match="not in the tables"):
        kernel.Tracks(*given, statistics.other_dof + np.int32(1), 6.0, 0.5, dof, standardiser.tables).noises(
            tracks.offsets, tracks.verified_offsets, CONSISTENCY
        )
    with pytest.raises(ValueError, match="not of the size"):
        kernel.Tracks(*given, statistics.other_dof, 6.0, 0.5, dof, (standardiser.tables[0][1:],) * 2).noises(
            tracks.offsets, tracks.verified_offsets, CONSISTENCY
        )
