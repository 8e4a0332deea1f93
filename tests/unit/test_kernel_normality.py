"""Statistics of samples by the compiled kernel are those of numpy."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import special

from sfm_audit.audit import normality
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.normality.statistics import sample_statistics

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")
SIZES = (0, 1, 2, 3, 4, 5, 7, 20, 31, 32, 33, 500, 2499, 2500, 2501, 6001)


def assert_same(samples):
    found, there = sample_statistics(samples)
    with numpy_only():
        expected, expected_there = sample_statistics(samples)
    assert there.tolist() == expected_there.tolist()
    length = np.array([min(np.abs(z).max(initial=0.0), 1e3) for z in samples])[there]
    for name, values in found.items():
        power = {"m3": 3, "projection_rest": 1, "span_1": 1, "span_2": 1}.get(name)
        rounding = 1e-13 if power is None else 1e-12 * length**power
        difference = np.abs(values[there] - expected[name][there])
        assert (difference <= 1e-9 * np.abs(expected[name][there]) + rounding).all(), (name, difference)
    return there


@pytest.mark.parametrize("make", ["normal", "wide", "shifted", "tiny", "heavy", "ties", "two_heaps"])
def test_samples_of_all_sizes(make):
    rng = np.random.default_rng(7)
    samples = []
    for size in SIZES:
        z = rng.standard_normal((size, 2))
        samples.append(
            {
                "normal": z,
                "wide": 30.0 * z,
                "shifted": z + 9.0,
                "tiny": 1e-3 * z,
                "heavy": rng.standard_cauchy((size, 2)),
                "ties": np.round(z),
                "two_heaps": np.where(rng.random((size, 1)) < 0.5, 1e-6 * z, 7.0 + 1e-6 * z),
            }[make]
        )
    assert assert_same(samples).sum() >= len(SIZES) - 3


def test_no_sample_is_left_to_numpy_and_memory_stays_ours():
    rng = np.random.default_rng(1)
    z = rng.standard_normal((9, 40, 2))
    z[1, 2, 0], z[2, 39, 1], z[3], z[4], z[5], z[6] = math.nan, -math.inf, 0.5, 1e120 * z[4], 0.0, 1e-120 * z[6]
    assert assert_same(list(z)).tolist() == [True, *[False] * 6, True, True]
    for one, expected in zip(normality.normality_tests_of(list(z)), map(normality.normality_tests, z), strict=True):
        assert_allclose(dataclasses.astuple(one), dataclasses.astuple(expected), rtol=1e-9, atol=1e-13)


def test_columns_of_memory_are_samples_too():
    z = np.random.default_rng(2).standard_normal((2, 90))
    assert_same([z.T, np.ascontiguousarray(z.T), z.T[::3]])


@pytest.mark.parametrize("num_points", [2, 9, 40, 700, 3000, 20_000])
def test_all_tests_are_those_of_one(num_points):
    rng = np.random.default_rng(num_points)
    samples = [
        rng.standard_normal((num_points, 2)),
        rng.standard_t(3.0, (num_points, 2)),
        2.0 * special.expit(rng.normal(size=(num_points, 2))),
    ]
    for one, z in zip(normality.normality_tests_of(samples), samples, strict=True):
        expected = dataclasses.asdict(normality.normality_tests(z))
        for name, value in dataclasses.asdict(one).items():
            assert_allclose(value, expected[name], rtol=1e-8 if name == "sw_p" else 1e-9, atol=1e-13, err_msg=name)


def test_a_large_sample_in_the_worst_order():
    """Whatever the distribution and the order, sorting takes n log n steps."""
    z = np.column_stack([np.linspace(50.0, -1.0, 150_000), np.full(150_000, 40.0)])
    assert_same([z, z[::-1]])
