"""Which misfit group is named as the cause, and which are material (method.md sections 5 and 7)."""

from __future__ import annotations

import math
from dataclasses import replace

from decision_samples import ABSORBED, CAMERA, NOT_TESTED, group, sound, with_misfit

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide, decide_all
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.decision.misfit import is_worth_nothing
from sfm_audit.audit.table.words import Member, MisfitGroup, Verdict

ACCEPTED, G, M = Verdict.ACCEPTED, MisfitGroup, Member


def test_the_cause_pays_most_among_the_material_groups():
    found = with_misfit(
        radial=group(q=0.01, px=0.3, gain=5.0),
        rolling_shutter=group(q=0.02, px=0.25, gain=9.0),
        smooth=group(q=0.001, px=0.19, gain=50.0),  # not material
        affine=group(q=0.06, px=0.9, gain=99.0),  # not significant
    )
    decision = decide(found, AuditConfig())
    assert decision.misfit.group is G.ROLLING_SHUTTER
    assert (decision.misfit.px, decision.misfit.q, decision.misfit.tau_px) == (0.25, 0.02, 0.2)
    assert decision.misfit.material == (G.RADIAL, G.ROLLING_SHUTTER)
    assert decision.misfit.also == ((G.RADIAL, 0.3),)
    assert decision.misfit.untested == ()
    text = "misfit_rolling_shutter: 0.25 px, q = 0.02 (also radial 0.30 px)"
    assert str(decision.members[M.MISFIT].reasons[0]) == text


def test_a_cause_below_tau_is_named_and_rejects_nothing():
    found = with_misfit(radial=group(q=0.01, px=0.1, gain=5.0), smooth=group(q=0.01, px=0.15, gain=1.0))
    decision = decide(found, AuditConfig())
    assert (decision.misfit.group, decision.misfit.px, decision.misfit.material) == (G.RADIAL, 0.1, ())
    assert decision.of(M.MISFIT) == ACCEPTED


def test_no_significant_group_has_no_cause():
    decision = decide(with_misfit(smooth=NOT_TESTED, radial=ABSORBED), AuditConfig())
    assert decision.misfit.group is None
    assert math.isnan(decision.misfit.px)
    assert math.isnan(decision.misfit.q)
    assert decision.misfit.tau_px == 0.2
    assert decision.misfit.untested == ((G.SMOOTH, NOT_TESTED.status),)
    assert (decision.misfit.material, decision.misfit.also) == ((), ())
    both = decide_all(Measured.of([with_misfit(smooth=NOT_TESTED), with_misfit(radial=group(q=0.01))]), AuditConfig())
    assert both.misfit.cause.tolist() == [-1, 0]  # what tables take for no cause


def test_only_a_tested_group_can_be_the_cause():
    odd = replace(NOT_TESTED, q=0.001, gain=99.0)  # no test has a q without being tested; the cause rests on the status
    decision = decide(with_misfit(radial=group(q=0.01, px=0.1), smooth=odd), AuditConfig())
    assert decision.misfit.group is G.RADIAL


def test_a_worth_that_nobody_knows_is_enough():
    assert not any(is_worth_nothing(group, None) for group in G)


def test_a_camera_without_principal_point_has_none_outside():
    decision = decide(sound(camera=replace(CAMERA, principal_point_px=None)), AuditConfig())
    assert decision.of(M.PLAUSIBLE) is ACCEPTED


def test_nothing_tested_has_no_decision_about_misfit():
    assert decide(sound(misfit=None), AuditConfig()).misfit is None
