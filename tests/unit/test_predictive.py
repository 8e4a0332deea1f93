"""The predictive t of the track noise model against SciPy and against simulation with known truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import optimize, stats

from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.noise.predictive import (
    StudentToNormal,
    TrackStandardiser,
    fit_track_prior,
    predict,
    student_to_normal,
)


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


def test_homoscedastic_noise_puts_nu0_at_its_bound():
    e, other, dof = simulate(np.random.default_rng(7), 20_000, 1e9, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    assert 100 < prior.nu0 <= 1e4 * (1 + 1e-12)
    assert prior.s0_px == pytest.approx(0.5, rel=0.01)


def test_too_few_or_zero_observations_have_no_prior():
    e, other, dof = simulate(np.random.default_rng(8), 19, 3.0, 0.5)
    assert math.isnan(fit_track_prior((e**2).sum(axis=0), other, dof).nu0)
    assert math.isnan(fit_track_prior(np.zeros(50), np.zeros(50), np.full(50, 3)).nu0)


@pytest.mark.parametrize(("nu0", "factor"), [(1.0, 1.0), (4.0, 0.7), (1e4, 1.6)])
def test_standardised_residuals_are_normal_and_the_factor_is_found(nu0, factor):
    e, other, dof = simulate(np.random.default_rng(9), 40_000, nu0, 0.5)
    prior = fit_track_prior((e**2).sum(axis=0), other, dof)
    standardiser = TrackStandardiser.build(predict(prior, other, dof))
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
    image = TrackStandardiser.build(predict(prior, other, dof)).standardise(np.zeros((2, 30)), slice(0, 30))
    assert math.isnan(image.factor)
    assert not image.converged
    assert image.z.shape == (30, 2)
