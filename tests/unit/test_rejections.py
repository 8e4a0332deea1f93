"""Which rejections count: both sides of every rule, and what becomes of the others."""

import pyarrow as pa
import pytest

from sfm_audit.audit.decision.rejections import (
    NAMEABLE_CODES,
    REJECTING_CODES,
    CountedRejections,
    counted,
    verdict_counts,
)
from sfm_audit.audit.table.words import WITNESS_CODES, Member, ReasonCode, Severity, Verdict

POSE, RADIAL = ReasonCode.POSE_NOT_OPTIMAL, ReasonCode.MISFIT_RADIAL
REJECTED = {"verdict": "rejected", "severity": "medium", "reasons": ["misfit_radial: 0.4 px", "low_coverage: 8 %"]}


@pytest.mark.parametrize(
    ("rule", "verdict"),
    [
        (CountedRejections(), "rejected"),
        (CountedRejections(frozenset({RADIAL})), "rejected"),
        (CountedRejections(frozenset({RADIAL, POSE})), "rejected"),
        (CountedRejections(frozenset({POSE})), "undetermined"),
        (CountedRejections(at_least=Severity.WEAK), "rejected"),
        (CountedRejections(at_least=Severity.MEDIUM), "rejected"),
        (CountedRejections(at_least=Severity.HARD), "undetermined"),
        (CountedRejections(frozenset({RADIAL}), Severity.HARD), "undetermined"),
        (CountedRejections(frozenset({POSE}), Severity.WEAK), "undetermined"),
    ],
    ids=str,
)
def test_a_rejection_counts_or_leaves_open(rule, verdict):
    assert rule.verdict(REJECTED) == verdict


@pytest.mark.parametrize("severity", [None, "dreadful"])
def test_without_a_severity_a_rejection_is_of_none(severity):
    row = {**REJECTED, "severity": severity}
    assert CountedRejections(at_least=Severity.WEAK).verdict(row) == Verdict.UNDETERMINED
    assert CountedRejections().verdict(row) == Verdict.REJECTED


@pytest.mark.parametrize("verdict", ["accepted", "undetermined", None])
def test_what_was_not_rejected_stays(verdict):
    rule = CountedRejections(frozenset({POSE}), Severity.HARD)
    assert rule.verdict({"verdict": verdict, "severity": None, "reasons": None}) == verdict


def test_no_rejection_without_reasons_counts_for_a_reason():
    assert CountedRejections(frozenset({POSE})).verdict({**REJECTED, "reasons": None}) == Verdict.UNDETERMINED


def test_the_rule_in_words():
    assert not CountedRejections()
    assert str(CountedRejections()) == ""
    assert str(CountedRejections(frozenset({RADIAL, POSE}), Severity.MEDIUM)) == (
        "only rejections for misfit_radial or pose_not_optimal and of severity medium or worse count, "
        "others are undetermined"
    )
    assert str(CountedRejections(at_least=Severity.HARD)).startswith("only rejections of severity hard count")
    assert CountedRejections(at_least=Severity.WEAK)
    assert CountedRejections(frozenset({POSE}))


PRIORS, PAIRS = ReasonCode.PRIORS_DISAGREE, ReasonCode.PAIRS_DISAGREE
LEFT_OPEN = {"verdict": "undetermined", "severity": None, "reasons": ["priors_disagree: 40 m", "low_coverage: 8 %"]}


@pytest.mark.parametrize(
    ("rule", "verdict"),
    [
        (CountedRejections(frozenset({PRIORS})), "rejected"),
        (CountedRejections(frozenset({PRIORS, POSE})), "rejected"),
        (CountedRejections(frozenset({POSE})), "undetermined"),
        (CountedRejections(frozenset({PAIRS})), "undetermined"),
        (CountedRejections(frozenset({ReasonCode.LOW_COVERAGE})), "undetermined"),  # no witness
        (CountedRejections(frozenset({PRIORS}), Severity.WEAK), "undetermined"),  # it has no severity
        (CountedRejections(at_least=Severity.WEAK), "undetermined"),
    ],
    ids=str,
)
def test_a_witness_that_leaves_open_rejects_where_it_is_named(rule, verdict):
    assert rule.verdict(LEFT_OPEN) == verdict
    assert rule.verdict({**LEFT_OPEN, "verdict": "accepted"}) == "accepted"


def test_a_witness_that_rejects_of_itself_does_not_reject_what_is_open():
    row = {**LEFT_OPEN, "reasons": ["pairs_disagree: 5 of 6", "misfit_radial: 0.1 px"]}
    assert CountedRejections(frozenset({PAIRS, RADIAL})).verdict(row) == "undetermined"


def test_the_rule_says_which_witness_rejects_by_name():
    assert str(CountedRejections(frozenset({PRIORS, POSE}))) == (
        "only rejections for pose_not_optimal or priors_disagree count, others are undetermined; "
        "priors_disagree rejects what it leaves open of itself"
    )
    assert "of itself" not in str(CountedRejections(frozenset({PRIORS}), Severity.HARD))
    assert {PRIORS, ReasonCode.FOLD_DISAGREES} <= set(NAMEABLE_CODES) - set(REJECTING_CODES)
    assert set(REJECTING_CODES) | set(WITNESS_CODES.values()) == set(NAMEABLE_CODES)


def test_only_codes_that_reject_can_be_asked_for():
    assert {RADIAL, POSE, ReasonCode.SHARED_CAMERA, ReasonCode.NOISE_DIFFERS} <= set(REJECTING_CODES)
    assert not {ReasonCode.LOW_COVERAGE, ReasonCode.K1_NOT_IDENTIFIED} & set(REJECTING_CODES)


def test_tables_keep_everything_but_the_verdict_and_are_counted():
    members = {str(member): ["rejected", None, "accepted"] for member in Member}
    table = pa.table(
        {
            **members,
            "verdict": ["rejected", "rejected", "accepted"],
            "severity": ["hard", "weak", None],
            "reasons": [["pose_not_optimal: 1"], ["noise_differs: 1"], []],
        }
    )
    assert counted(table, CountedRejections()) is table
    of_pose = counted(table, CountedRejections(frozenset({POSE})))
    narrow = counted(table, CountedRejections(at_least=Severity.HARD))
    assert narrow.column("verdict").to_pylist() == ["rejected", "undetermined", "accepted"]
    assert of_pose.equals(narrow)
    assert narrow.drop_columns(["verdict"]).equals(table.drop_columns(["verdict"]))
    counts = verdict_counts(narrow)
    assert (counts["num_rejected"], counts["num_undetermined"], counts["num_accepted"]) == (1, 1, 1)
    assert (counts["num_rejected_pose"], counts["num_undetermined_pose"], counts["num_accepted_pose"]) == (1, 0, 1)
