"""What each test may not depend on, and what multiplicity may not reorder."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.testing import assert_allclose

from sfm_audit.audit import normality
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg, holm
from sfm_audit.audit.normality.kolmogorov import kolmogorov_p
from sfm_audit.audit.normality.null_tables import NullTable, null_p


@st.composite
def residuals(draw):
    """(n, 2), n = 4..60, normal with a few coarse (tied) or heavy-tailed ones."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    z = rng.standard_t(draw(st.sampled_from([2.0, 5.0, 1e6])), (draw(st.integers(4, 60)), 2))
    return np.round(z, 2) if draw(st.booleans()) else z


powers_of_two = st.integers(-8, 8).map(lambda exponent: 2.0**exponent)
SHIFT_AND_SCALE_FREE = (
    "ks_fitted_stat",
    "ks_fitted_p",
    "dap_stat",
    "dap_p",
    "sw_stat",
    "sw_p",
    "skewness",
    "kurtosis_excess",
)


@given(z=residuals(), gain=st.floats(1e-3, 1e3), shift=st.floats(-5.0, 5.0))
def test_shape_does_not_depend_on_location_and_scale(z, gain, shift):
    expected, found = normality.normality_tests(z), normality.normality_tests(gain * (z + shift))
    for name in SHIFT_AND_SCALE_FREE:
        assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-9, err_msg=name)


@given(z=residuals())
def test_a_mirror_image_changes_only_the_sign_of_the_skewness(z):
    expected, found = normality.normality_tests(z), normality.normality_tests(-z)
    assert_allclose(found.skewness, -expected.skewness, rtol=1e-9, atol=1e-12)
    for name in ("ks_p", "ks_fitted_p", "ks_norm_p", "ks_norm_unscaled_p", "dap_p", "sw_p", "kurtosis_excess"):
        assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-12, err_msg=name)


@given(z=residuals(), gain=powers_of_two, seed=st.integers(0, 1000))
def test_lengths_do_not_depend_on_directions_and_scale(z, gain, seed):
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(z))
    x = np.cos(angle) * z[:, 0] - np.sin(angle) * z[:, 1]
    y = np.sin(angle) * z[:, 0] + np.cos(angle) * z[:, 1]
    turned = np.column_stack((x, y))
    expected = normality.normality_tests(z)
    found = normality.normality_tests(turned)
    assert_allclose(found.ks_norm_unscaled_p, expected.ks_norm_unscaled_p, rtol=1e-6, atol=1e-12)
    assert_allclose(normality.normality_tests(gain * turned).ks_norm_p, expected.ks_norm_p, rtol=1e-6, atol=1e-12)


@given(z=residuals(), seed=st.integers(0, 1000))
def test_order_does_not_matter(z, seed):
    shuffled = np.random.default_rng(seed).permutation(z)
    expected, found = normality.normality_tests(z), normality.normality_tests(shuffled)
    for name in (*SHIFT_AND_SCALE_FREE, "ks_p", "ks_norm_p", "ks_norm_unscaled_p"):
        assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-7, atol=1e-10, err_msg=name)


@given(z=residuals())
def test_p_values_are_probabilities(z):
    tests = normality.normality_tests(z)
    for name in ("ks_p", "ks_fitted_p", "ks_norm_p", "ks_norm_unscaled_p", "dap_p", "sw_p"):
        assert 0.0 <= getattr(tests, name) <= 1.0, name
    for name in ("ks_stat", "ks_fitted_stat", "ks_norm_stat", "ks_norm_unscaled_stat", "sw_stat"):
        assert 0.0 < getattr(tests, name) <= 1.0, name


@given(
    size=st.integers(1, 200_000),
    low=st.floats(0.0, 1.0),
    step=st.floats(0.0, 0.5),
)
def test_kolmogorov_p_falls_with_distance(size, low, step):
    p, smaller = kolmogorov_p(low, size), kolmogorov_p(min(1.0, low + step), size)
    assert 0.0 <= smaller <= p + 1e-5
    assert p <= 1.0


@given(
    table=st.sampled_from(NullTable),
    size=st.integers(10, 200_000),
    low=st.floats(0.0, 6.0),
    step=st.floats(0.0, 2.0),
)
def test_fitted_p_falls_with_distance(table, size, low, step):
    p, smaller = null_p(table, low, size), null_p(table, low + step, size)
    assert 0.0 < smaller <= p <= 1.0


p_values = npst.arrays(np.float64, st.integers(0, 30), elements=st.one_of(st.floats(0.0, 1.0), st.just(np.nan)))


@pytest.mark.parametrize("adjust", [holm, benjamini_hochberg])
@given(p=p_values, seed=st.integers(0, 1000))
def test_adjusting_keeps_order_bounds_and_gaps(adjust, p, seed):
    adjusted = adjust(p)
    tested = ~np.isnan(p)
    assert np.array_equal(np.isnan(adjusted), ~tested)
    assert np.all(adjusted[tested] >= p[tested])
    assert np.all(adjusted[tested] <= 1.0)
    assert np.all(np.diff(adjusted[tested][np.argsort(p[tested], kind="stable")]) >= 0.0)
    order = np.random.default_rng(seed).permutation(len(p))
    assert np.array_equal(adjust(p[order]), adjusted[order], equal_nan=True)


@given(p=p_values)
def test_false_discovery_rate_asks_less_than_family_wise_error(p):
    q, strict = benjamini_hochberg(p), holm(p)
    tested = ~np.isnan(p)
    assert np.all(q[tested] <= strict[tested] * (1.0 + 1e-12))


@given(p=p_values, level=st.floats(1e-6, 0.999))
def test_q_rejects_what_the_step_up_procedure_rejects(p, level):
    tested = np.sort(p[~np.isnan(p)])
    passing = np.flatnonzero(tested <= level * np.arange(1, len(tested) + 1) / max(len(tested), 1) * (1.0 - 1e-9))
    num_rejected = passing[-1] + 1 if len(passing) else 0
    assert np.count_nonzero(benjamini_hochberg(p) <= level) >= num_rejected
    generous = np.flatnonzero(tested <= level * np.arange(1, len(tested) + 1) / max(len(tested), 1) * (1.0 + 1e-9))
    assert np.count_nonzero(benjamini_hochberg(p) <= level) <= (generous[-1] + 1 if len(generous) else 0)
