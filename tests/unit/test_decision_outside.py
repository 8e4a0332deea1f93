"""What witnesses outside of the image make of it (method.md section 13), and when a witness may reject."""

from __future__ import annotations

from dataclasses import replace

import pytest
from decision_samples import sound

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision import outside
from sfm_audit.audit.decision.decide import decide
from sfm_audit.audit.decision.judged import NOT_ASKED, VERDICTS, Judgement
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.decision.outside import disagrees, judge_outside
from sfm_audit.audit.table.witnesses import (
    MAX_FALSE_ALARMS,
    WITNESSES,
    Witness,
    WitnessStatement,
    WitnessWords,
    wilson_upper,
)
from sfm_audit.audit.table.words import REASONS, WITNESS_CODES, Member, Severity, Verdict

SETTINGS = AuditConfig()
AGREES = WitnessStatement(Witness.PAIRS, 0.0, 0.5, "0 of 8 pairs", 1.0)
AGAINST = WitnessStatement(Witness.PAIRS, 0.6, 0.5, "6 of 8 pairs", 0.001)


@pytest.fixture(params=[True, False], ids=["may reject", "may not"])
def may_reject(request, monkeypatch):
    makes = Verdict.REJECTED if request.param else Verdict.UNDETERMINED
    words = {**REASONS, **{c: replace(REASONS[c], makes=makes) for c in WITNESS_CODES.values()}}
    monkeypatch.setattr(outside, "REASONS", words)
    return makes


def judged(said):
    """What the witnesses make of an image, and of another one that nobody was asked about."""
    both = judge_outside(Measured.of([sound(testimonies=said), sound()]), SETTINGS)
    assert both.verdict[1] == NOT_ASKED
    if both.verdict[0] == NOT_ASKED:
        assert not both.said
        return None
    return Judgement(VERDICTS[both.verdict[0]], tuple(each.reason(0) for each in both.said))


@pytest.mark.parametrize("said", [None, ()])
def test_no_witness_no_verdict(said):
    assert judged(said) is None
    decision = decide(sound(testimonies=said), SETTINGS)
    assert decision.of(Member.OUTSIDE) is None
    assert decision.verdict == Verdict.ACCEPTED


def test_a_witness_that_agrees_accepts():
    judgement = judged((AGREES,))
    assert (judgement.verdict, judgement.reasons) == (Verdict.ACCEPTED, ())


@pytest.mark.parametrize("witness", Witness)
def test_a_witness_that_disagrees_is_named_with_its_numbers(may_reject, witness):
    against = replace(AGAINST, witness=witness, unit="deg")
    judgement = judged((AGREES, against))
    assert judgement.verdict == may_reject
    (reason,) = judgement.reasons
    assert (reason.code, reason.member) == (WITNESS_CODES[witness], Member.OUTSIDE)
    assert (reason.text, reason.value, reason.limit, reason.unit) == ("6 of 8 pairs", 0.6, 0.5, "deg")
    assert decide(sound(testimonies=(against,)), SETTINGS).verdict == may_reject


def test_images_that_witnesses_contradict_have_each_its_own_reasons(may_reject):
    said = [(replace(AGAINST, score=0.1 * k, text=f"{k} of 10 pairs"),) for k in (9, 6, 7)]
    twice = replace(AGAINST, score=0.8, limit=0.4, text="8 of 10 pairs")
    images = [said[0], (AGREES,), (*said[1], twice), said[2]]
    found = judge_outside(Measured.of([sound(testimonies=each) for each in images]), SETTINGS)
    assert [VERDICTS[place] for place in found.verdict] == [may_reject, Verdict.ACCEPTED, may_reject, may_reject]
    first, second = found.said
    assert first.rows.tolist() == [0, 2, 3]
    told = [first.reason(k) for k in range(3)]
    assert [(each.text, each.value, each.limit) for each in told] == [
        (f"{k} of 10 pairs", 0.1 * k, 0.5) for k in (9, 6, 7)
    ]
    assert (second.rows.tolist(), second.reason(0).value, second.reason(0).limit) == ([2], 0.8, 0.4)


@pytest.mark.parametrize(
    ("score", "q", "against"),
    [(0.51, 0.04, True), (0.5, 0.04, False), (0.51, 0.05, False), (0.51, float("nan"), True), (float("nan"), 0, False)],
)
def test_it_takes_an_effect_and_where_there_is_a_q_significance(score, q, against):
    assert disagrees(replace(AGAINST, score=score, q=q), SETTINGS) is against


def test_the_strongest_word_counts(monkeypatch):
    codes = WITNESS_CODES
    words = {**REASONS, codes[Witness.FOLD]: replace(REASONS[codes[Witness.FOLD]], makes=Verdict.REJECTED)}
    words[codes[Witness.PAIRS]] = replace(words[codes[Witness.PAIRS]], makes=Verdict.UNDETERMINED)
    monkeypatch.setattr(outside, "REASONS", words)
    both = (AGAINST, replace(AGAINST, witness=Witness.FOLD))
    assert judged(both).verdict == Verdict.REJECTED


def test_a_witness_may_reject_after_enough_healthy_images_with_hardly_a_false_alarm():
    """Wilson, 95 %: 0 of 380 ends at 1.0008 %, 0 of 381 at 0.998 % (SciPy 1.17, binomtest)."""
    assert MAX_FALSE_ALARMS == 0.01
    words = WitnessWords("", "")
    assert not words.may_reject
    assert not replace(words, num_healthy=380).may_reject
    assert replace(words, num_healthy=381).may_reject
    assert not replace(words, num_healthy=381, num_false_alarms=1).may_reject
    assert replace(words, num_healthy=2000, num_false_alarms=5).may_reject


def test_pairs_reject_and_no_other_witness_does_yet():
    assert [witness for witness in Witness if WITNESSES[witness].may_reject] == [Witness.PAIRS]
    decision = decide(sound(testimonies=(AGAINST,)), SETTINGS)
    assert (decision.verdict, decision.severity) == (Verdict.REJECTED, Severity.HARD)


@pytest.mark.parametrize(
    ("num", "total", "upper"), [(0, 300, 0.012643), (3, 300, 0.028983), (5, 10, 0.763407), (0, 0, 1.0), (4, 4, 1.0)]
)
def test_wilson_s_upper_end(num, total, upper):
    assert wilson_upper(num, total) == pytest.approx(upper, abs=2e-6)


@pytest.mark.parametrize("witness", Witness)
def test_what_a_witness_makes_follows_from_what_was_measured_of_it(witness):
    makes = Verdict.REJECTED if WITNESSES[witness].may_reject else Verdict.UNDETERMINED
    assert REASONS[WITNESS_CODES[witness]].makes == makes
    assert REASONS[WITNESS_CODES[witness]].members == (Member.OUTSIDE,)
