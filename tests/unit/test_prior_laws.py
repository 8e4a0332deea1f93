"""The laws that position priors are judged by, number by number against SciPy, on alignments made for it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2, f

from sfm_audit.audit.alignment.positions import PositionAlignment
from sfm_audit.audit.alignment.similarity import Similarity
from sfm_audit.audit.table.thresholds import MAX_PRIOR_CHI2
from sfm_audit.audit.witnesses.priors import _by_covariance, _statement, hotelling_p, prior_p, spread_p

CHI2 = np.array([0.5, 2.0, 4.0, 9.0, 12.0, 60.0])


def aligned(spread, fitted=(True,) * 6):
    similarity = Similarity(2.0, np.eye(3), np.zeros(3))
    nothing = np.zeros((6, 3))
    return PositionAlignment(similarity, nothing, CHI2, nothing, spread, 0.3, np.array(fitted))


@pytest.mark.parametrize("spread", [0.2, 1.0])
def test_covariances_that_hold_are_believed(spread):
    judged = _by_covariance(aligned(spread))
    assert_allclose(judged.p, chi2.sf(CHI2, 3), rtol=1e-12)
    assert_allclose(judged.chi2, CHI2, rtol=1e-9)
    assert (judged.spread, judged.sd_scale) == (spread, 0.3)


@pytest.mark.parametrize("spread", [1.2, 3.0])
def test_covariances_that_are_too_small_are_enlarged_with_the_law_of_the_median(spread):
    judged = _by_covariance(aligned(spread))
    assert_allclose(judged.p, f.sf(CHI2 / spread**2 / 3, 3, 1.58 * 6), rtol=1e-9)
    assert (judged.spread, judged.sd_scale) == (spread, pytest.approx(0.3 * spread))
    assert_allclose(spread_p(CHI2, 100), f.sf(CHI2 / 3, 3, 158), rtol=1e-9)


def test_an_estimated_covariance_is_hotelling_s():
    """Residuals in the fit against the covariance of the others, those outside against that of all."""
    degrees = 10.0
    p = hotelling_p(aligned(1.0, (True, True, True, False, False, True)), degrees)
    without = CHI2[:3] * 9 / (10 - CHI2[:3])
    assert_allclose(p[:3], f.sf(without * 7 / (3 * 9), 3, 7), rtol=1e-9)
    assert_allclose(p[3:5], f.sf(CHI2[3:5] * 8 / (3 * 10), 3, 8), rtol=1e-9)
    assert p[5] == 0.0  # no residual is farther from all than its own share allows
    at = hotelling_p(aligned(1.0), CHI2[3])
    assert at[3] == 0.0
    assert at[2] > 0


def test_a_statement_has_score_limit_and_words():
    said = _statement(2.5, "m", 13.0, 0.004)
    assert (said.score, said.limit, said.q) == (13.0, MAX_PRIOR_CHI2, 0.004)
    assert said.text == "its centre is 2.5 m from its prior, chi^2 = 13 of 3, q = 0.004"
    assert_allclose(prior_p(CHI2), chi2.sf(CHI2, 3), rtol=1e-12)
