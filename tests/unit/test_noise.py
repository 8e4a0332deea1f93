"""Robust variance fits: the estimating equation, method.md's iteration as written, and known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import integrate, stats

from sfm_audit.audit.noise.fits import (
    CONSISTENCY,
    CUTOFF,
    _excess,
    _first_step,
    fit_constant_variance,
    fit_variance,
    scoring_step,
)


def as_written(y, predictor, iterations=3000):
    """method.md section 2, literally: start (median / 0.4549, 0), scoring steps until no s_j moves by 1e-8."""
    theta = np.array([np.median(y) / 0.4549, 0.0])
    for _ in range(iterations):
        previous, theta = theta, scoring_step(y, predictor, theta)
        old, new = previous[0] + previous[1] * predictor, theta[0] + theta[1] * predictor
        if np.all(np.abs(new - old) <= 1e-12 * old):
            break
    return theta


def test_consistency_factor_is_the_integral():
    expected, _ = integrate.quad(lambda z: min(z * z, CUTOFF**2) * stats.norm.pdf(z), -12, 12, points=[-2, 2])
    assert pytest.approx(expected, abs=1e-10) == CONSISTENCY
    assert round(CONSISTENCY, 5) == pytest.approx(0.92054, abs=1.1e-5)


@pytest.mark.parametrize("noise", ["normal", "laplace", "t2"])
@pytest.mark.parametrize("n", [2, 21, 400, 5000])
def test_constant_fit_solves_its_equation_and_equals_the_iteration(noise, n):
    rng = np.random.default_rng(n)
    draw = {"normal": rng.normal, "laplace": rng.laplace, "t2": lambda size: rng.standard_t(2, size)}[noise]
    y = (0.7 * draw(size=n)) ** 2
    fit = fit_constant_variance(y)
    assert fit.converged
    assert np.minimum(y / fit.detector_px2, 4.0).mean() == pytest.approx(CONSISTENCY, rel=1e-12)
    assert_allclose(as_written(y, np.zeros(n))[0], fit.detector_px2, rtol=1e-6)


def test_scale_is_consistent_at_the_normal_and_robust_to_outliers():
    rng = np.random.default_rng(0)
    y = rng.normal(0, 0.5, 200_000) ** 2
    assert math.sqrt(fit_constant_variance(y).detector_px2) == pytest.approx(0.5, rel=0.005)
    y[:4000] = 400.0  # 2 % gross errors of 20 px
    assert math.sqrt(fit_constant_variance(y).detector_px2) == pytest.approx(0.5, rel=0.06)


def test_two_parameters_are_recovered():
    rng = np.random.default_rng(1)
    predictor = rng.gamma(2.0, 2.0, 40_000)
    y = rng.normal(size=40_000) ** 2 * (0.25 + 0.04 * predictor)
    fit = fit_variance(y, predictor)
    assert fit.converged
    assert_allclose([fit.detector_px2, fit.structure], [0.25, 0.04], rtol=0.04)


@pytest.mark.parametrize("seed", range(30))
def test_two_parameter_fit_equals_the_iteration_as_written(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(40, 2000))
    predictor = rng.gamma(1.0, 1.0, n)
    y = rng.normal(size=n) ** 2 * (rng.uniform(0, 0.3) + rng.uniform(0, 0.5) * predictor)
    fit, theta = fit_variance(y, predictor), as_written(y, predictor)
    assert_allclose([fit.detector_px2, fit.structure], theta, rtol=1e-5, atol=1e-6 * theta.sum())


@pytest.mark.parametrize("power", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("rows", [1, 2])
def test_the_first_step_is_the_scoring_step(power, rows):
    """At power 3 the line falls below zero: both start at theta_1 = 0."""
    rng = np.random.default_rng(rows)
    predictor = rng.gamma(2.0, 1.0, 500)
    y = rng.normal(size=(rows, 500)) ** 2 * predictor**power
    variance = fit_constant_variance(y).detector_px2
    step = _first_step(_excess(y, np.full(1, variance)), predictor, variance, rows)
    assert_allclose(step, scoring_step(y, predictor, np.array([variance, 0.0])), rtol=1e-9)
    assert (step[0] == 0.0) == (power == 3.0)


def test_equal_predictors_are_a_constant():
    y = np.random.default_rng(2).normal(size=(2, 50)) ** 2
    assert fit_variance(y, np.full(50, 0.3)) == fit_constant_variance(y)


def test_no_detector_noise_is_a_boundary_that_is_handled():
    rng = np.random.default_rng(3)
    predictor = rng.gamma(2.0, 1.0, 4000)
    y = rng.normal(size=4000) ** 2 * 0.5 * predictor
    fit = fit_variance(y, predictor)
    assert fit.structure == pytest.approx(0.5, rel=0.1)
    assert 0 <= fit.detector_px2 < 0.05


@given(seed=st.integers(0, 500), gain=st.sampled_from([1e-6, 0.25, 1e4]))
def test_fits_follow_the_unit(seed, gain):
    rng = np.random.default_rng(seed)
    predictor = rng.gamma(1.0, 1.0, 60)
    y = rng.normal(size=60) ** 2 * (0.2 + 0.4 * predictor)
    one, other = fit_variance(y, predictor), fit_variance(y * gain**2, predictor * gain**2)
    assert_allclose(other.detector_px2, one.detector_px2 * gain**2, rtol=1e-6, atol=1e-9 * gain**2)
    assert_allclose(other.structure, one.structure, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("y", [np.zeros(50), np.empty(0), np.array([0.0] * 10 + [1.0, 1.0])])
def test_undetermined_where_the_bulk_is_zero(y):
    fit = fit_constant_variance(y)
    assert math.isnan(fit.detector_px2)
    assert not fit.converged
