from __future__ import annotations

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import normality
from sfm_audit.audit.normality.kolmogorov import kolmogorov_p
from sfm_audit.audit.normality.null_tables import NullTable, load, null_p


def floats(tests):
    return {k: v for k, v in dataclasses.asdict(tests).items() if isinstance(v, float)}


@pytest.mark.parametrize(
    "z",
    [np.empty((0, 2)), np.full((30, 2), np.nan), np.array([[0.0, 1.0], [np.inf, 2.0]] * 20)],
    ids=["none", "nan", "inf"],
)
def test_nothing_runs_without_finite_values(z):
    tests = normality.normality_tests(z)
    assert all(math.isnan(value) for value in floats(tests).values())
    assert (tests.num_values, tests.sw_num_values) == (z.size, 0)


def test_equal_values_have_a_distance_but_no_shape():
    tests = normality.normality_tests(np.full((30, 2), 0.1))
    assert tests.ks_p < 1e-12
    assert 0.0 < tests.ks_norm_p < 1e-6
    for name in (
        "ks_fitted_stat",
        "ks_fitted_p",
        "dap_stat",
        "dap_p",
        "sw_stat",
        "sw_p",
        "skewness",
        "kurtosis_excess",
    ):
        assert math.isnan(getattr(tests, name)), name
    assert tests.sw_num_values == 0


def test_zeros_have_no_scale():
    tests = normality.normality_tests(np.zeros((30, 2)))
    assert math.isnan(tests.ks_norm_p)
    assert tests.ks_stat == 0.5
    assert tests.ks_norm_unscaled_stat == 1.0
    assert tests.ks_norm_unscaled_p == 0.0


@pytest.mark.parametrize(
    ("num_points", "not_run"),
    [
        (1, {"ks_fitted", "ks_norm", "dap", "sw"}),
        (2, {"dap"}),
        (3, {"dap"}),
        (4, set()),
    ],
)
def test_what_runs_on_few_points(num_points, not_run):
    tests = normality.normality_tests(np.random.default_rng(0).standard_normal((num_points, 2)))
    missing = {
        name
        for name in ("ks", "ks_fitted", "ks_norm", "ks_norm_unscaled", "dap", "sw")
        if math.isnan(getattr(tests, f"{name}_p"))
    }
    assert missing == not_run
    assert all(math.isnan(getattr(tests, f"{name}_stat")) for name in not_run)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_tests_without_a_unit_survive_absurd_units(scale):
    z = np.random.default_rng(3).standard_normal((100, 2))
    expected, found = normality.normality_tests(z), normality.normality_tests(z * scale)
    for name in ("ks_fitted_p", "ks_norm_p", "dap_p", "sw_p", "skewness", "kurtosis_excess"):
        assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, err_msg=name)
    assert found.ks_p < 1e-20
    assert found.ks_norm_unscaled_p < 1e-20


def test_one_absurd_outlier_is_still_tested():
    """A point that projects almost from the camera plane must not turn the image into an untested one."""
    z = np.random.default_rng(4).standard_normal((100, 2))
    z[17, 0] = 1e180
    tests = normality.normality_tests(z)
    assert tests.dap_p < 1e-10
    assert tests.sw_p < 1e-10
    assert tests.ks_fitted_p < 1e-10
    assert tests.ks_norm_p < 1e-10
    assert tests.ks_p > 1e-3  # one value of 200 moves D by 1 / 200


def test_input_is_left_alone():
    z = np.random.default_rng(5).standard_normal((50, 2))
    z.flags.writeable = False
    normality.normality_tests(z)


def test_a_view_of_columns_gives_the_same_numbers():
    wide = np.random.default_rng(6).standard_normal((50, 4))
    assert normality.normality_tests(wide[:, 1:3]) == normality.normality_tests(wide[:, 1:3].copy())


def test_shapiro_sees_whole_observations_in_order():
    rng = np.random.default_rng(7)
    z = rng.standard_normal((5001, 2))  # 10002 values: every third observation
    tests = normality.normality_tests(z)
    assert tests.sw_num_values == 2 * len(z[::3]) == 3334
    assert tests.sw_p == normality.shapiro_wilk(z[::3].ravel()).p
    spoilt = z.copy()
    spoilt[1::3] = 50.0
    spoilt[2::3] = -50.0
    assert normality.normality_tests(spoilt).sw_p == tests.sw_p
    assert normality.thin_observations(z[:2500]).shape == (2500, 2)
    assert normality.thin_observations(z[:2501]).shape == (1251, 2)


def test_shapiro_does_not_extrapolate_royston():
    assert math.isnan(normality.shapiro_wilk(np.random.default_rng(8).standard_normal(5001)).p)
    assert math.isnan(normality.shapiro_wilk(np.array([0.0, 1.0])).p)


def test_individual_tests_agree_with_the_battery():
    z = np.random.default_rng(9).standard_normal((70, 2))
    tests = normality.normality_tests(z)
    assert (tests.ks_stat, tests.ks_p) == normality.ks(z.ravel())
    assert (tests.ks_fitted_stat, tests.ks_fitted_p) == normality.ks_fitted(z.ravel())
    assert (tests.ks_norm_stat, tests.ks_norm_p) == normality.ks_norm(z)
    assert (tests.ks_norm_unscaled_stat, tests.ks_norm_unscaled_p) == normality.ks_norm_unscaled(z)
    assert (tests.dap_stat, tests.dap_p) == normality.dagostino_pearson(z.ravel())
    assert (tests.sw_stat, tests.sw_p) == normality.shapiro_wilk(z.ravel())
    assert (tests.skewness, tests.kurtosis_excess) == normality.sample_shape(z.ravel())


def test_kolmogorov_p_at_the_ends():
    assert kolmogorov_p(1.0, 10) == 0.0
    assert kolmogorov_p(0.05, 10) == 1.0
    assert kolmogorov_p(0.001, 100) == 1.0
    assert math.isnan(kolmogorov_p(math.nan, 10))
    assert_allclose(kolmogorov_p(0.7, 1), 0.6, rtol=1e-12)  # one value: P(|U - 1/2| >= 0.2)


@pytest.mark.parametrize("table", list(NullTable))
def test_null_tables_are_complete(table):
    data = load(table)
    assert np.all(np.diff(data.quantile, axis=1) > 0.0)
    assert np.all(np.diff(data.p) < 0.0)
    assert np.all(np.diff(data.num_values) > 0.0)
    assert data.num_values[-1] == np.inf
    assert math.isnan(null_p(table, 0.9, int(data.num_values[0]) - 1))
    assert math.isnan(null_p(table, math.nan, 100))
    assert null_p(table, 0.0, 100) == 1.0


@pytest.mark.parametrize("table", list(NullTable))
@pytest.mark.parametrize("size", [10, 37, 100, 4000, 10**6])
def test_p_is_continuous_at_the_last_entry_and_never_clipped(table, size):
    """log p goes on in the square of the statistic, with the slope of the last decade."""
    statistics = np.sqrt(np.linspace(0.2, 20.0, 4000))
    log_p = np.log([null_p(table, float(statistic), size) for statistic in statistics])
    steps = np.diff(log_p)
    assert np.all(steps < 0.0)
    assert log_p[-1] < -50.0
    beyond = log_p[1:] < math.log(1e-4)
    assert_allclose(steps[beyond][2:], steps[-1], rtol=1e-6)
    last_decade = (log_p[1:] < math.log(1e-3)) & ~beyond
    assert_allclose(steps[last_decade].mean(), steps[-1], rtol=0.15)
    assert np.abs(steps).max() < 0.5


@pytest.mark.parametrize("table", list(NullTable))
@pytest.mark.parametrize("size", [210, 300, 390, 2000])
def test_between_tabulated_sizes_p_goes_with_the_inverse_root(table, size):
    sizes = load(table).num_values
    low, high = sizes[sizes < size][-1], sizes[sizes > size][0]
    share = (low**-0.5 - size**-0.5) / (low**-0.5 - high**-0.5)
    at_low, found, at_high = (null_p(table, 0.45, int(n)) for n in (low, size, high))
    assert_allclose((found - at_low) / (at_high - at_low), share, atol=0.02)


def test_the_package_does_not_import_scipy_stats():
    modules = "sys, sfm_audit.audit.normality, sfm_audit.audit.misfit.multiplicity"
    code = f"import {modules}; print('scipy.stats' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
