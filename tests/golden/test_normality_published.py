"""The simulated null distributions against tables that others have published."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import normality
from sfm_audit.audit.normality.null_tables import NullTable, load, modified_normal, null_p

# Molin & Abdi, "New tables and numerical approximation for the Kolmogorov-Smirnov/Lilliefors/Van Soest test of
# normality" (1998), 100,000 draws: critical D at 20, 15, 10, 5 and 1 %.
MOLIN_ABDI = {
    5: (0.2893, 0.3027, 0.3188, 0.3427, 0.3959),
    10: (0.2171, 0.2273, 0.2410, 0.2616, 0.3037),
    20: (0.1589, 0.1666, 0.1764, 0.1920, 0.2226),
    30: (0.1315, 0.1378, 0.1460, 0.1590, 0.1848),
    40: (0.1147, 0.1204, 0.1275, 0.1386, 0.1616),
}
LEVELS = (0.20, 0.15, 0.10, 0.05, 0.01)


@pytest.mark.parametrize("size", MOLIN_ABDI)
def test_lilliefors_normal_is_molin_and_abdi_s(size):
    for level, distance in zip(LEVELS, MOLIN_ABDI[size], strict=True):
        lower, upper = (null_p(NullTable.KS_FITTED, modified_normal(distance + d, size), size) for d in (1e-3, -1e-3))
        assert lower < level < upper


@pytest.mark.parametrize(("statistic", "level"), [(0.775, 0.15), (0.819, 0.10), (0.895, 0.05), (1.035, 0.01)])
@pytest.mark.parametrize("size", [20, 40, 100])
def test_modified_normal_points_are_stephens(statistic, level, size):
    """Stephens (1974), table 1A, case 3: printed with three digits, from simulations of 10,000."""
    assert_allclose(null_p(NullTable.KS_FITTED, statistic, size), level, rtol=0.16)


@pytest.mark.parametrize(
    ("statistic", "level"), [(0.926, 0.15), (0.990, 0.10), (1.094, 0.05), (1.190, 0.025), (1.308, 0.01)]
)
@pytest.mark.parametrize("size", [10, 40, 100, 1000, 4000])
def test_modified_exponential_points_are_stephens(statistic, level, size):
    """Stephens (1974), table 1A, case 4."""
    assert_allclose(null_p(NullTable.KS_NORM, statistic, size), level, rtol=0.16)


@pytest.mark.parametrize("size", [10, 20, 40, 60, 100])
def test_lilliefors_tail_is_dallal_and_wilkinson_s(size):
    """The formula of R's nortest::lillie.test (Dallal & Wilkinson 1986, p <= 0.1, N <= 100), good to a few percent."""
    for distance in np.linspace(0.85, 1.25, 9) / math.sqrt(size):
        shifted = size + 2.78019
        log_p = -7.01256 * distance**2 * shifted + 2.99587 * distance * math.sqrt(shifted)
        expected = math.exp(log_p - 0.122119 + 0.974598 / math.sqrt(size) + 1.67997 / size)
        if 1e-3 < expected < 0.1:
            assert_allclose(null_p(NullTable.KS_FITTED, modified_normal(distance, size), size), expected, rtol=0.12)


def test_the_5_percent_point_is_not_free_of_the_sample_size():
    """Stephens' 0.895 holds near N = 100; the limit is 0.910 (the cubic's constant)."""
    table = load(NullTable.KS_FITTED)
    points = dict(zip(table.num_values, table.quantile[:, table.p == 0.05].ravel(), strict=True))
    assert_allclose(points[25], 0.892, atol=0.002)
    assert_allclose(points[100], 0.8965, atol=0.002)
    assert_allclose(points[np.inf], 0.910, atol=0.002)


def test_a_sample_by_hand():
    """Five values whose D can be computed on paper: -1, 0, 1 at z = 0, +-1, and two at the mean."""
    outcome = normality.ks_fitted(np.array([-1.0, 0.0, 0.0, 0.0, 1.0]))
    # mean 0, sd sqrt(1/2): F(-sqrt 2) = 0.0786496; the largest step is at 0: 0.8 - 0.5 and 0.5 - 0.2.
    assert_allclose(outcome.statistic, 0.3, rtol=1e-12)
