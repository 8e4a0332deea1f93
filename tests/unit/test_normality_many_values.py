"""Samples of many values: what is asked of few values, or sorted by 16 bits first, is what all of them say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import special, stats

from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.normality.many_values import MANY_POINTS, in_order, largest_distances, statistics_of_many
from sfm_audit.audit.normality.statistics import sample_statistics

RNG = np.random.default_rng(7)


@pytest.mark.parametrize("scale", [1e-9, 0.3, 1.0, 40.0, 1e9])
def test_values_are_in_order(scale):
    values = scale * np.concatenate([RNG.normal(size=900), RNG.standard_cauchy(90), [0.0, -0.0, 1.0, 1.0]])
    assert_array_equal(in_order(values, -6.0, 6.0), np.sort(values))
    assert_array_equal(in_order(values**2, 0.0, 18.0), np.sort(values**2))


def test_distances_of_few_values_are_those_of_all():
    """SciPy asks all values; sizes around multiples of eight, and distributions that are far from the hypothesis."""
    sizes = [1, 2, 7, 8, 9, 10, 16, 17, 63, 64, 65, 500, 1001]
    for draw in (RNG.normal, lambda size: 3.0 + RNG.normal(size=size), RNG.standard_cauchy, np.ones, np.zeros):
        samples = [np.sort(draw(size=size)) if draw not in {np.ones, np.zeros} else draw(size) for size in sizes]
        offsets = np.concatenate([[0], np.cumsum(sizes)])
        found = largest_distances(np.concatenate(samples), offsets, lambda x, _: special.ndtr(x))
        assert_allclose(found, [stats.ks_1samp(x, special.ndtr).statistic for x in samples], rtol=1e-13)


def test_few_distribution_functions_are_asked():
    asked = []
    x = np.sort(RNG.normal(size=4000))
    largest_distances(x, np.array([0, 4000]), lambda values, _: asked.append(values.size) or special.ndtr(values))
    assert sum(asked) < 1200


@pytest.mark.parametrize("num_points", [MANY_POINTS, 700, 2501, 3333])
def test_statistics_are_those_of_the_stack(num_points):
    samples = [RNG.standard_t(4.0, (num_points, 2)) for _ in range(2)] + [1e5 * RNG.normal(size=(num_points, 2))]
    with numpy_only():
        found, there = sample_statistics([*samples, np.full((num_points, 2), np.nan), np.ones((num_points, 2))])
    assert there.tolist() == [True, True, True, False, False]
    for row, z in enumerate(samples):
        half = np.sort(0.5 * (z**2).sum(axis=1))
        values = np.sort(z.ravel())
        few = z[:: -(-z.size // 5000)].ravel()
        expected = {
            "ks": stats.ks_1samp(values, special.ndtr).statistic,
            "ks_fitted": stats.ks_1samp((values - values.mean()) / values.std(ddof=1), special.ndtr).statistic,
            "ks_norm": stats.ks_1samp(half / half.mean(), stats.expon.cdf).statistic,
            "ks_norm_unscaled": stats.ks_1samp(half, stats.expon.cdf).statistic,
            "m2": stats.moment(values, 2),
            "m3": stats.moment(values, 3),
            "m4": stats.moment(values, 4),
            "span_1": few.max() - few.min(),
            "total_sq": few.size * few.var(),
        }
        for name, value in expected.items():
            assert_allclose(found[name][row], value, rtol=1e-9, atol=1e-12 * expected["m2"] ** 1.5, err_msg=name)


def test_no_sample_depends_on_those_beside_it():
    samples = [RNG.normal(size=(num, 2)) for num in (130, 400, 401, 2000, 3000, 128)]
    whole = statistics_of_many(samples)
    for row, z in enumerate(samples):
        assert_array_equal(statistics_of_many([z])[0], whole[row])
        assert_array_equal(statistics_of_many(samples[row:])[0], whole[row])
