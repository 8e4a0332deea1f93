"""The arithmetic behind docs/realtruth.md: rates, intervals, ranks and rules, against SciPy and by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from scripts import real_truth
from scripts.realtruth.bounds import Bound
from scripts.realtruth.rates import Rate, auc, spearman, wilson
from scripts.realtruth.worth import SHIFTS, Least, as_decided
from sfm_audit.audit.table.words import GROUPS


@pytest.mark.parametrize(("num", "of"), [(0, 10), (1, 29), (28, 29), (29, 29), (114, 119), (7, 198)])
def test_wilson_is_scipy_s(num, of):
    low, high = stats.binomtest(num, of).proportion_ci(0.95, method="wilson")
    assert_allclose(wilson(num, of), (low, high), atol=1e-6)


@pytest.mark.parametrize(("num", "of"), [(1, 0), (-1, 3), (4, 3)])
def test_what_is_no_rate_has_no_interval(num, of):
    with pytest.raises(ValueError, match="no rate"):
        wilson(num, of)


def test_rates_say_their_numbers():
    assert str(Rate(28, 29)) == "28 of 29 = 96.6% (82.8% .. 99.4%)"
    assert str(Rate(0, 0)) == "-"


def test_ranks_are_scipy_s():
    rng = np.random.default_rng(4)
    x, y = pd.Series(rng.integers(0, 9, 60)).astype(float), pd.Series(rng.normal(size=60))
    x[3] = np.nan
    known = x.notna()
    assert_allclose(spearman(x, y), stats.spearmanr(x[known], y[known]).statistic, rtol=1e-12)
    yes = y > 0.3
    u = stats.mannwhitneyu(x[known & yes], x[known & ~yes]).statistic
    assert_allclose(auc(x, yes), u / ((known & yes).sum() * (known & ~yes).sum()), rtol=1e-12)


def test_ranks_of_nothing_are_unknown():
    nothing = pd.Series([1.0, 2.0, 3.0])
    assert np.isnan(spearman(nothing, nothing))
    assert np.isnan(auc(nothing, pd.Series([True] * 3)))


@pytest.mark.parametrize(
    ("num", "limit", "at_least", "holds"),
    [(2, 0.02, False, True), (3, 0.02, False, False), (95, 0.95, True, True), (94, 0.95, True, False)],
)
def test_a_bound_holds_on_its_limit(num, limit, at_least, holds):
    assert Bound("words", Rate(num, 100), limit, at_least).holds is holds


def test_a_bound_on_nothing_holds():
    assert Bound("words", Rate(0, 0), 0.95, at_least=True).holds


def misfits(**changes):
    row = {f"misfit_{group}_px_joint": 0.0 for group in GROUPS} | {f"misfit_{group}_q_joint": 0.5 for group in GROUPS}
    row |= {"misfit_smooth_px_joint": 0.3, "misfit_smooth_q_joint": 0.01, "misfit_group": "smooth"}
    row |= {"misfit_px": 0.3}
    row |= {"misfit_worth_deg": 0.0, "misfit_worth_centre": 0.0, "misfit_worth_focal_rel": 0.0}
    return pd.DataFrame([row | changes])


@pytest.mark.parametrize(
    ("changes", "rejected"),
    [
        ({}, False),
        ({"misfit_worth_deg": 0.05}, True),
        ({"misfit_worth_deg": 0.0499}, False),
        ({"misfit_worth_deg": 0.5, "misfit_group": "principal_point"}, False),
        ({"misfit_worth_centre": 0.001, "misfit_group": "principal_point"}, True),
        ({"misfit_worth_focal_rel": -0.003}, True),
        ({"misfit_worth_deg": np.nan}, True),
        ({"misfit_worth_deg": 1.0, "misfit_smooth_q_joint": 0.05}, False),
        ({"misfit_worth_deg": 1.0, "misfit_smooth_px_joint": 0.2}, False),
    ],
)
def test_a_misfit_counts_when_it_is_there_and_worth_something(changes, rejected):
    assert Least(0.05, 0.001, 0.003, SHIFTS).rejects(misfits(**changes)).tolist() == [rejected]


@pytest.mark.parametrize(
    ("changes", "rejected"),
    [
        ({"misfit_worth_deg": 0.0199}, False),
        ({"misfit_worth_deg": 0.02}, True),
        ({"misfit_worth_deg": 1.0, "misfit_group": "tangential"}, False),
        ({"misfit_worth_deg": 1.0, "misfit_group": None}, False),
        ({"misfit_px": 0.4}, False),
        ({"misfit_px": 0.401}, True),
        ({"misfit_worth_deg": np.nan}, True),
    ],
)
def test_the_rule_of_the_audit_is_its_own(changes, rejected):
    assert as_decided(misfits(**changes)).tolist() == [rejected]


def test_without_models_the_script_says_so(tmp_path, capsys):
    assert real_truth.main([str(tmp_path), "--check"]) == 0
    assert capsys.readouterr().out.startswith("skipped: ")
