"""Statistics and p-values equal SciPy's (scipy 1.14 .. 1.17) where SciPy has them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from sfm_audit.audit import normality
from sfm_audit.audit.normality.kolmogorov import kolmogorov_p, one_sided_p

SIZES = (8, 9, 11, 12, 20, 40, 79, 80, 141, 400, 1000, 4000)


def sample(kind, size):
    rng = np.random.default_rng([size, len(kind)])
    return KINDS[kind](rng, size)


KINDS = {
    "normal": lambda rng, size: rng.standard_normal(size),
    "shifted": lambda rng, size: 0.1 + 1.2 * rng.standard_normal(size),
    "uniform": lambda rng, size: rng.uniform(-1.7, 1.7, size),
    "heavy_tails": lambda rng, size: rng.standard_t(3, size),
    "cauchy": lambda rng, size: rng.standard_cauchy(size),
    "skewed": lambda rng, size: rng.standard_exponential(size) - 1.0,
    "ties": lambda rng, size: np.round(rng.standard_normal(size), 1),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_ks_is_scipy_s(kind, size):
    values = sample(kind, size)
    expected = stats.kstest(values, "norm", method="exact")
    found = normality.ks(values)
    assert_allclose(found.statistic, expected.statistic, rtol=1e-12)
    assert_allclose(found.p, expected.pvalue, rtol=1e-3, atol=1e-300)
    assert_allclose(found.p, expected.pvalue, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 10, 30, 79, 80, 100, 200, 1000, 4000, 10000, 100_000])
def test_kolmogorov_p_is_the_exact_one(size):
    """To 1e-5 everywhere, and in its first three digits from 0.05 down to 1e-300."""
    distances = np.concatenate((np.linspace(0.2, 1.5, 40), np.linspace(1.5, 26.0, 25))) / np.sqrt(size)
    distances = np.unique(np.minimum(distances, 0.999))
    expected = stats.kstwo.sf(distances, size)
    found = np.array([kolmogorov_p(distance, size) for distance in distances])
    assert_allclose(found, expected, rtol=0.0, atol=1e-5)
    tail = (expected < 0.05) & (expected > 1e-300)
    assert_allclose(found[tail], expected[tail], rtol=1e-4)
    assert np.all(np.diff(found) <= 1e-7)


@pytest.mark.parametrize(("size", "distance"), [(50, 0.3), (512, 0.2), (513, 0.2), (4000, 0.02), (10000, 0.15)])
def test_one_sided_p_is_scipy_s_smirnov(size, distance):
    from scipy.special import smirnov  # noqa: PLC0415 (slow for large N: the reason why ours exists)

    assert_allclose(one_sided_p(distance, size), smirnov(size, distance), rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_dagostino_pearson_is_scipy_s(kind, size):
    values = sample(kind, size)
    expected = stats.normaltest(values)
    found = normality.dagostino_pearson(values)
    assert_allclose(found.statistic, expected.statistic, rtol=1e-9)
    assert_allclose(found.p, expected.pvalue, rtol=1e-9, atol=1e-300)
    shape = normality.sample_shape(values)
    assert_allclose(shape.skewness, stats.skew(values), rtol=1e-10, atol=1e-13)
    assert_allclose(shape.kurtosis_excess, stats.kurtosis(values), rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [3, 4, 5, 6, 7, *SIZES, 5000])
def test_shapiro_wilk_is_scipy_s(kind, size):
    values = sample(kind, size)
    expected = stats.shapiro(values)
    found = normality.shapiro_wilk(values)
    assert_allclose(found.statistic, expected.statistic, rtol=0.0, atol=1e-7)
    assert_allclose(found.p, expected.pvalue, rtol=1e-3, atol=1e-12)
    assert_allclose(found.p, expected.pvalue, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("num_points", [20, 150, 2600])
def test_the_battery_is_scipy_s(num_points):
    z = np.random.default_rng(num_points).standard_t(6, (num_points, 2))
    tests = normality.normality_tests(z)
    assert_allclose(tests.ks_p, stats.kstest(z.ravel(), "norm").pvalue, atol=1e-5)
    assert_allclose(tests.dap_p, stats.normaltest(z, axis=None).pvalue, rtol=1e-9)
    half_squares = 0.5 * np.sum(z**2, axis=1)
    expected = stats.kstest(half_squares, "expon")
    assert_allclose(tests.ks_norm_unscaled_stat, expected.statistic, rtol=1e-12)
    assert_allclose(tests.ks_norm_unscaled_p, expected.pvalue, atol=1e-5)
    scaled = stats.kstest(half_squares / half_squares.mean(), "expon")
    assert_allclose(tests.ks_norm_stat, scaled.statistic, rtol=1e-12)
    fitted = stats.kstest((z.ravel() - z.mean()) / z.std(ddof=1), "norm")
    assert_allclose(tests.ks_fitted_stat, fitted.statistic, rtol=1e-12)
    thinned = z if z.size <= 5000 else z[::2]
    assert tests.sw_num_values == thinned.size
    assert_allclose(tests.sw_p, stats.shapiro(thinned.ravel()).pvalue, atol=1e-5)
