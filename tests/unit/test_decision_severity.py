"""How bad a rejection is: every branch, both sides of each limit (method.md section 11)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from decision_samples import (
    MATERIAL,
    NAN,
    SOUND,
    camera,
    group,
    noise,
    own,
    parts,
    sound,
    with_misfit,
    worth,
    worth_misfit,
)

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide, decide_all
from sfm_audit.audit.decision.judged import VERDICTS, Judged
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.decision.severity import SEVERITIES, severities_of
from sfm_audit.audit.table.words import SEVERITY_ORDER, Member, Severity, Verdict

HARD, MEDIUM, WEAK = Severity.HARD, Severity.MEDIUM, Severity.WEAK


def shift(**changes):
    """A principal point is rejected by the shift of the centre, whatever it turns the image by."""
    return worth_misfit("principal_point", **changes)


@pytest.mark.parametrize(
    ("diagnostics", "severity"),
    [
        (SOUND, None),
        (sound(pose_offset_px=NAN), None),  # undetermined is no rejection
        (parts(inconsistent=True), HARD),
        (own(), HARD),
        (sound(pose_offset_px=2.0), HARD),
        (camera(folds_over=True), HARD),
        (noise(ks_stat=0.2), WEAK),
        (noise(ks_p=0.01), WEAK),
        (with_misfit(radial=MATERIAL), MEDIUM),  # its worth is not known
        (worth_misfit(deg=NAN, focal=0.5), MEDIUM),
        (worth_misfit(deg=0.2, focal=0.01), MEDIUM),
        (worth_misfit(deg=0.2001), HARD),
        (worth_misfit(focal=0.01001), HARD),
        (worth_misfit(focal=-0.01001), HARD),
        (shift(deg=0.0199, focal=0.00099), WEAK),
        (shift(deg=0.0199, focal=-0.00099), WEAK),
        (shift(deg=0.02, focal=0.0), MEDIUM),
        (shift(deg=0.0, focal=0.001), MEDIUM),
        (shift(deg=0.0, focal=-0.001), MEDIUM),
        (shift(deg=0.0199, focal=NAN), WEAK),
        (worth_misfit(deg=0.2001, focal=NAN), HARD),
        (replace(shift(deg=0.0, focal=0.0), noise=noise(ks_stat=0.2).noise), WEAK),
        (replace(worth_misfit(deg=0.1), noise=noise(ks_stat=0.2).noise), MEDIUM),
        (replace(shift(deg=0.0, focal=0.0), pose_offset_px=2.0), HARD),
    ],
)
def test_the_severity_of_a_rejection(diagnostics, severity):
    assert decide(diagnostics, AuditConfig()).severity is severity


def test_severity_does_not_depend_on_the_policy():
    assert decide(noise(ks_p=0.01), AuditConfig(policy="camera")).severity is WEAK


@pytest.mark.parametrize(("verdict", "severity"), [(Verdict.REJECTED, HARD), (Verdict.ACCEPTED, None)])
def test_a_witness_outside_is_hard(verdict, severity):
    members = {member: judged(Verdict.ACCEPTED) for member in Member}
    members[Member.OUTSIDE] = judged(verdict)
    (found,) = severities_of(members, np.full((1, 3), NAN))
    assert (None if found < 0 else SEVERITIES[found]) is severity


def judged(verdict):
    return Judged(np.array([VERDICTS.index(verdict)]), ())


def test_the_worth_is_that_of_the_named_cause():
    found = with_misfit(
        radial=group(q=0.01, px=0.3, gain=1.0, worth=worth(deg=9.0)),
        tangential=group(q=0.01, px=0.3, gain=2.0, worth=worth(deg=0.001, focal=0.0)),
    )
    decisions = decide_all(Measured.of([found, SOUND, sound(misfit=None)]), AuditConfig())
    assert decisions.misfit.worth[0].tolist() == [0.001, 0.01, 0.0]
    assert np.isnan(decisions.misfit.worth[1:]).all()
    assert decisions.decision(0).severity is WEAK
    assert [decisions.decision(i).severity for i in (1, 2)] == [None, None]
    assert decisions.severity.tolist() == [SEVERITIES.index(WEAK), -1, -1]  # -1 is null in tables


def test_hard_is_listed_first():
    assert sorted([WEAK, MEDIUM, HARD], key=SEVERITY_ORDER.__getitem__) == [HARD, MEDIUM, WEAK]
    assert set(SEVERITY_ORDER) == set(Severity)
