"""The predictive t of the track noise model against SciPy and against simulation with known truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import optimize, stats

from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.noise.others import ByRow
from sfm_audit.audit.noise.predictive import (
    StudentToNormal,
    TrackStandardiser,
    predict,
    student_to_normal,
)
from sfm_audit.audit.noise.prior import _maximise, _sums_of, fit_track_prior


def simulate(rng, num, nu0, s0):
    """Whitened residuals e (2, num), nu_k a_k^2 and nu_k of tracks whose variances follow the prior."""
    variance = s0**2 * nu0 / rng.chisquare(nu0, num)
    dof = 2 * rng.integers(3, 12, num) - 5
    return np.sqrt(variance) * rng.normal(size=(2, num)), variance * rng.chisquare(dof), dof


@pytest.mark.parametrize("nu", [1.1, 2.0, 3.7, 11.2, 80.0, 1003.0])
def test_transformation_is_scipy_s(nu):
    t = np.concatenate([np.linspace(-9, 9, 401), [1e-9, -1e-9, 0.0, 35.0, -35.0]])
    expected = stats.norm.isf(stats.t.sf(np.abs(t), nu)) * np.sign(t)
    finite = np.isfinite(expected) & (np.abs(expected) < 37)
    assert finite.sum() > 350
    assert_allclose(student_to_normal(t, np.full_like(t, nu))[finite], expected[finite], rtol=1e-9, atol=1e-12)
    table = StudentToNormal(np.array([nu]))
    rows = np.zeros(t.size, dtype=np.int64)
    assert_allclose(table(t, rows, np.full_like(t, nu))[finite], expected[finite], atol=1e-8)


def test_far_tail_goes_through_logarithms():
    """Where T underflows: -ln(1 - Phi(z)) = -ln(1 - T(t)), both by SciPy's logarithms."""
    nu, t = 1e4, np.array([45.0, 80.0, 300.0])
    z = student_to_normal(t, np.full_like(t, nu))
    # ln of the t tail by numerical integration of the density from t, scaled by its value at t
    for z_i, t_i in zip(z, t, strict=True):
        log_pdf = stats.t.logpdf(t_i, nu)
        ratio, _ = np.polynomial.laguerre.laggauss(40)
        weights = np.polynomial.laguerre.laggauss(40)[1]
        slope = (nu + 1) * t_i / (nu + t_i**2)
        values = np.exp(stats.t.logpdf(t_i + ratio / slope, nu) - log_pdf + ratio)
        log_tail = log_pdf + math.log(weights @ values / slope)
        assert stats.norm.logsf(z_i) == pytest.approx(log_tail, rel=1e-9)
    assert (np.diff(z) > 0).all()


@pytest.mark.parametrize(("nu0", "s0"), [(1.0, 0.3), (4.0, 0.5), (30.0, 1.2)])
def test_prior_is_recovered(nu0, s0):
    e, other, dof = simulate(np.random.default_rng(5), 60_000, nu0, s0)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    assert prior.nu0 == pytest.approx(nu0, rel=0.08)
    assert prior.s0_px == pytest.approx(s0, rel=0.02)


def test_prior_is_the_maximum_that_a_general_optimiser_finds():
    e, other, dof = simulate(np.random.default_rng(6), 500, 3.0, 0.5)
    sq = (e**2).sum(axis=0)

    def minus_log_likelihood(x):  # method.md (4), written as there
        nu0, s0_sq = np.exp(x)
        nu = nu0 + dof
        scale_sq = (nu0 * s0_sq + other) / nu
        return np.sum(np.log(scale_sq) + (nu + 2) / 2 * np.log1p(sq / (nu * scale_sq)))

    found = optimize.minimize(minus_log_likelihood, [1.0, -1.0], method="Nelder-Mead", options={"xatol": 1e-9})
    prior = fit_track_prior(sq, other, dof)
    assert_allclose(np.log([prior.nu0, prior.s0_px**2]), found.x, atol=1e-5)


def likelihood_of(nu0, s0_px, sq, other, dof):
    """method.md (4), written as there."""
    nu = nu0 + dof
    scale_sq = (nu0 * s0_px**2 + other) / nu
    return -np.sum(np.log(scale_sq) + (nu + 2) / 2 * np.log1p(sq / (nu * scale_sq)))


@pytest.mark.parametrize("seed", [0, 1, 49])
def test_prior_on_the_ridge_reaches_the_maximum_of_scipy(seed):
    """Nearly equal short tracks: gradient steps along the ridge used to end at nu0 = 87, 84, 92 for 28, 22, 35."""
    rng = np.random.default_rng(seed)
    variance, dof = 0.25 * np.exp(0.3 * rng.normal(size=4000)), 2 * rng.integers(3, 5, 4000) - 5
    sq, other = variance * rng.chisquare(2, 4000), variance * rng.chisquare(dof)
    prior = fit_track_prior(sq, other, dof)
    best = max(
        -optimize.minimize(
            lambda x: -likelihood_of(*np.exp(x), sq, other, dof), [np.log(nu0), np.log(0.5)], method="Nelder-Mead"
        ).fun
        for nu0 in (3.0, 30.0, 300.0)
    )
    assert prior.converged
    assert likelihood_of(prior.nu0, prior.s0_px, sq, other, dof) >= best - 1e-6


@pytest.mark.parametrize("nu0", [0.1, 1e4])
@pytest.mark.parametrize("s0_sq", [0.02, 0.25, 7.0])
def test_a_start_on_a_bound_does_not_end_there(nu0, s0_sq):
    e, other, dof = simulate(np.random.default_rng(11), 20_000, 5.0, 0.5)
    sq = (e**2).sum(axis=0)
    prior = fit_track_prior(sq, other, dof)
    found = _maximise(np.log([nu0, s0_sq]), _sums_of(sq, other, dof), sq.size)
    assert found.converged
    assert_allclose(np.exp(found.x), [prior.nu0, prior.s0_px**2], rtol=1e-6)


@pytest.mark.parametrize("unit", [1e-14, 1e-3, 1e30])
def test_prior_has_the_unit_of_the_residuals(unit):
    e, other, dof = simulate(np.random.default_rng(12), 2000, 4.0, 0.5)
    sq = (e**2).sum(axis=0)
    prior, scaled = fit_track_prior(sq, other, dof), fit_track_prior(sq * unit**2, other * unit**2, dof)
    assert scaled.nu0 == pytest.approx(prior.nu0, rel=1e-7)
    assert scaled.s0_px == pytest.approx(prior.s0_px * unit, rel=1e-7)


def test_a_likelihood_without_maximum_says_so():
    """Where half of the tracks have no residuals at all, s0 = 0 is infinitely likely."""
    e, other, dof = simulate(np.random.default_rng(13), 1000, 4.0, 0.5)
    exact = np.arange(1000) % 2 == 0
    prior = fit_track_prior(np.where(exact, 0.0, (e**2).sum(axis=0)), np.where(exact, 0.0, other), dof)
    assert not prior.converged


def test_residuals_that_overflow_have_no_prior():
    e, other, dof = simulate(np.random.default_rng(14), 1000, 4.0, 0.5)
    far = np.where(np.arange(1000) < 5, 1e308, (e**2).sum(axis=0))
    assert math.isnan(fit_track_prior(far, other, dof).nu0)
    assert math.isnan(fit_track_prior(np.where(far > 1e9, np.nan, far), other, dof).nu0)


def test_homoscedastic_noise_puts_nu0_at_its_bound():
    e, other, dof = simulate(np.random.default_rng(7), 20_000, 1e9, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    assert 100 < prior.nu0 <= 1e4 * (1 + 1e-12)
    assert prior.converged
    assert prior.s0_px == pytest.approx(0.5, rel=0.01)


def test_too_few_or_zero_observations_have_no_prior():
    e, other, dof = simulate(np.random.default_rng(8), 19, 3.0, 0.5)
    assert math.isnan(fit_track_prior((e**2).sum(axis=0), other, dof).nu0)
    assert math.isnan(fit_track_prior(np.zeros(50), np.zeros(50), np.full(50, 3)).nu0)


@pytest.mark.parametrize(("nu0", "factor"), [(1.0, 1.0), (4.0, 0.7), (1e4, 1.6)])
def test_standardised_residuals_are_normal_and_the_factor_is_found(nu0, factor):
    e, other, dof = simulate(np.random.default_rng(9), 40_000, nu0, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    standardiser = TrackStandardiser.build(predict(prior, ByRow(other, dof, dof), dof.size))
    image = standardiser.standardise(factor * e[:, :20_000], slice(0, 20_000))
    assert image.converged
    assert image.factor == pytest.approx(factor, rel=0.02)
    assert fit_constant_variance(image.z**2).detector_px2 == pytest.approx(1.0, abs=1e-8)
    # dividing by the track's own spread would leave heavy tails; the predictive t does not
    assert stats.kstest(image.z.ravel(), "norm").pvalue > 0.001
    assert abs(stats.kurtosis(image.z.ravel())) < 0.1
    assert abs(np.corrcoef(image.z.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(image.z.T**2)[0, 1]) < 0.03


def test_all_zero_residuals_have_no_factor():
    e, other, dof = simulate(np.random.default_rng(10), 100, 3.0, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    image = TrackStandardiser.build(predict(prior, ByRow(other, dof, dof), dof.size)).standardise(
        np.zeros((2, 30)), slice(0, 30)
    )
    assert math.isnan(image.factor)
    assert not image.converged
    assert image.z.shape == (30, 2)


@pytest.mark.parametrize("factor", [1e3, 1e9, 1e-9])
def test_residuals_far_from_the_prediction_find_their_factor(factor):
    e, other, dof = simulate(np.random.default_rng(11), 400, 8.0, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    standardiser = TrackStandardiser.build(predict(prior, ByRow(other, dof, dof), dof.size))
    usual, far = (standardiser.standardise(scale * e, slice(0, 400)) for scale in (1.0, factor))
    assert far.converged
    assert_allclose(far.factor, factor * usual.factor, rtol=1e-6)


def test_residuals_that_are_all_clipped_have_no_slope_and_cost_no_warning():
    # a wrong pose moves all points one way: y given x is far out as well, so that nothing is left to give a slope
    e, other, dof = simulate(np.random.default_rng(12), 60, 8.0, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    moved = np.stack([np.full(60, 300.0), np.full(60, 900.0)]) + e
    image = TrackStandardiser.build(predict(prior, ByRow(other, dof, dof), dof.size)).standardise(moved, slice(0, 60))
    assert image.factor > 100.0
    assert np.isfinite(image.z).all()
