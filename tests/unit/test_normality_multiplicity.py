from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg, holm

# Benjamini & Hochberg (1995), section 4: fifteen p-values of a thrombolysis study; at 5 % Hochberg's procedure rejects
# three, theirs four.
THROMBOLYSIS = np.array(
    [
        0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344,
        0.0459, 0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0000,
    ]
)  # fmt: skip


def test_the_example_of_benjamini_and_hochberg():
    assert np.count_nonzero(benjamini_hochberg(THROMBOLYSIS) <= 0.05) == 4
    assert np.count_nonzero(holm(THROMBOLYSIS) <= 0.05) == 3


def test_adjusted_p_by_hand():
    """R 4: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm") and "BH"."""
    p = np.array([0.01, 0.04, 0.03, 0.005])
    assert_allclose(holm(p), [0.03, 0.06, 0.06, 0.02], rtol=1e-14)
    assert_allclose(benjamini_hochberg(p), [0.02, 0.04, 0.04, 0.02], rtol=1e-14)


@pytest.mark.parametrize("adjust", [holm, benjamini_hochberg])
def test_not_tested_does_not_count(adjust):
    p = np.array([np.nan, 0.01, np.nan, 0.04, 0.03, 0.005, np.nan])
    tested = ~np.isnan(p)
    assert_array_equal(np.isnan(adjust(p)), ~tested)
    assert_array_equal(adjust(p)[tested], adjust(p[tested]))
    assert adjust(np.empty(0)).shape == (0,)
    assert np.isnan(adjust(np.full(3, np.nan))).all()


@pytest.mark.parametrize("adjust", [holm, benjamini_hochberg])
def test_rows_are_families_of_their_own(adjust):
    p = np.random.default_rng(0).uniform(size=(5, 6))
    p[1, 2] = p[3] = np.nan
    assert_array_equal(adjust(p), np.array([adjust(row) for row in p]))


@pytest.mark.parametrize("adjust", [holm, benjamini_hochberg])
@pytest.mark.parametrize("bad", [-0.1, 1.5])
def test_what_is_no_p_value_is_refused(adjust, bad):
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        adjust(np.array([0.5, bad]))
