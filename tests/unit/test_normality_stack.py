"""Many small samples at once are what each of them is by itself."""

from __future__ import annotations

import dataclasses
import math
from contextlib import nullcontext

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import normality
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.normality import kolmogorov


@pytest.fixture(autouse=True, params=["numpy", "compiled"])
def _path(request):
    with numpy_only() if request.param == "numpy" else nullcontext():
        yield


def assert_same(samples):
    found = normality.normality_tests_of(samples)
    assert len(found) == len(samples)
    for one, z in zip(found, samples, strict=True):
        expected = dataclasses.asdict(normality.normality_tests(z))
        for name, value in dataclasses.asdict(one).items():
            rounding = 1e-13 if name in {"skewness", "kurtosis_excess"} else 1e-300
            assert_allclose(value, expected[name], rtol=1e-9, atol=rounding, err_msg=f"{name} of {len(z)} points")
            assert type(value) is type(expected[name])


@pytest.mark.parametrize("num_points", [0, 1, 2, 3, 4, 5, 6, 19, 39, 40, 64, 65])
@pytest.mark.parametrize("make", ["normal", "wide", "shifted"])
def test_samples_of_one_size(num_points, make):
    rng = np.random.default_rng(num_points)
    z = rng.standard_normal((30, num_points, 2))
    assert_same(list({"normal": z, "wide": 8.0 * z**3, "shifted": z + 4.0}[make]))


def test_samples_that_are_no_samples_are_left_to_the_single_test():
    z = np.random.default_rng(1).standard_normal((9, 5, 2))
    z[1, 2, 0], z[3], z[4], z[5], z[6] = math.nan, 0.5, 1e120 * z[4], 0.0, 1e-120 * z[6]
    z[7, 0, 0] = math.inf
    assert_same([*z, *np.random.default_rng(2).standard_normal((7, 11, 2)), np.empty((0, 2))])


@pytest.mark.parametrize("num_points", [1, 5])
@pytest.mark.parametrize("value", [0.0, 0.5, math.nan, math.inf])
def test_none_of_one_size_is_a_sample(num_points, value):
    """Images that all see one point, exactly where it was projected."""
    assert_same([np.full((num_points, 2), value) for _ in range(8)])


def test_what_lies_on_a_line_is_normal_for_shapiro_and_wilk():
    assert_same([np.linspace(-1.0 - k, 1.0, 10).reshape(5, 2) for k in range(6)])
    assert_same([np.repeat([[0.0, 1.0]], 5, axis=0) + k for k in range(6)])  # two values only


@pytest.mark.parametrize("num_values", [1, 2, 10, 79, 80, 128, 700])
def test_p_values_of_one_size(num_values):
    distances = np.concatenate([np.linspace(0.4 / num_values, 1.0, 80), np.linspace(0.5, 2.0, 40) / num_values**0.5])
    expected = [kolmogorov.kolmogorov_p(d, num_values) for d in distances.tolist()]
    assert_allclose(
        kolmogorov.kolmogorov_p_of(distances, np.full(len(distances), num_values)), expected, rtol=1e-9, atol=1e-300
    )


@pytest.mark.parametrize("num_points", [2, 5, 19, 39, 40, 65, 300, 5001])
def test_the_bits_of_a_sample_do_not_depend_on_those_beside_it(num_points):
    """Tables must not depend on how images are spread over processes."""
    rng = np.random.default_rng(num_points)
    samples = list(rng.standard_t(5, (9, num_points, 2)) * rng.uniform(0.7, 1.3, (9, 1, 1)))
    together = normality.normality_columns_of(samples)
    for first, last in [(0, 1), (3, 4), (0, 2), (2, 6), (8, 9)]:
        apart = normality.normality_columns_of(samples[first:last])
        for name, column in together.items():
            assert apart[name].tobytes() == column[first:last].tobytes(), name
    mixed = normality.normality_columns_of([samples[0], rng.standard_normal((2 * num_points, 2)), *samples[1:4]])
    for name, column in together.items():
        assert mixed[name][[0, 2, 3, 4]].tobytes() == column[:4].tobytes(), name
