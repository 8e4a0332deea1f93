"""Every branch and every setting of the decision, values just on both sides of each limit (method.md section 7).

A line of audit/decision that can be deleted or changed without a red test here is not finished:
scripts/mutate_decision.py changes them one by one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from decision_samples import (
    ABSORBED,
    EXACT_PX,
    EXCLUDED,
    FOCAL,
    LENS,
    MATERIAL,
    NAN,
    NOISE,
    NOT_TESTED,
    OWN,
    SOUND,
    camera,
    group,
    misfit,
    moved,
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
from sfm_audit.audit.decision.diagnostics import SharedMisfit
from sfm_audit.audit.decision.judged import NOT_ASKED, VERDICTS, Judged
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.table.words import (
    GROUPS,
    POLICIES,
    Member,
    MisfitGroup,
    ReasonCode,
    Verdict,
    strongest,
    verdict_under,
)

ACCEPTED, REJECTED, UNDETERMINED = Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED
C, M = ReasonCode, Member
SHIFTS = (MisfitGroup.TANGENTIAL, MisfitGroup.PRINCIPAL_POINT)
HALF = 0.5**0.5  # RMS of half a pixel in x and in y
BELOW, ABOVE = (1.36 / math.sqrt(580) + 0.03 + side for side in (-1e-6, 1e-6))  # D of 290 observations
ASKS_FOR_MEASUREMENTS = (M.MISFIT, M.CAMERA, M.NOISE, M.KS)
EXCESS = 0.2 - 1.36 / math.sqrt(580)
FEW = {"num_inliers": 3, "noise": replace(NOISE, num_standardised=3), "misfit": misfit(num_tested=3)}
NOTHING = sound(num_inliers=0, noise=replace(NOISE, num_standardised=0), misfit=None, camera=None, own=None)


def worthless(px, **changes):
    """A radial misfit of so many px that changes nothing."""
    return with_misfit(radial=replace(MATERIAL, px=px, worth=worth(deg=0.001, focal=0.0001, centre=0.0)), **changes)


# member, diagnostics, settings, verdict, codes
TABLE = [
    # a sound image, and one without inliers: 0 inliers are no exact projections
    *((member, SOUND, {}, ACCEPTED, []) for member in M if member is not M.OUTSIDE),
    *(
        (member, replace(NOTHING, largest_residual_px=0.0), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS])
        for member in M
        if member is not M.OUTSIDE
    ),
    # projections that are no measurements: asked before the number of observations
    *((m, sound(largest_residual_px=EXACT_PX), {}, UNDETERMINED, [C.EXACT_PROJECTIONS]) for m in ASKS_FOR_MEASUREMENTS),
    *(
        (m, sound(largest_residual_px=1e-9, **FEW), {}, UNDETERMINED, [C.EXACT_PROJECTIONS])
        for m in ASKS_FOR_MEASUREMENTS
    ),
    *((m, sound(largest_residual_px=1.001 * EXACT_PX), {}, ACCEPTED, []) for m in ASKS_FOR_MEASUREMENTS),
    (M.MISFIT, sound(largest_residual_px=0.0, num_inliers=1), {}, UNDETERMINED, [C.EXACT_PROJECTIONS]),
    *((m, sound(largest_residual_px=NAN), {}, ACCEPTED, []) for m in ASKS_FOR_MEASUREMENTS),
    # verdict_ks
    (M.KS, noise(ks_p=0.05), {}, ACCEPTED, []),
    (M.KS, noise(ks_p=0.0499), {}, REJECTED, [C.KS_REJECTED]),
    (M.KS, noise(ks_p=0.0499), {"alpha": 0.01}, ACCEPTED, []),
    (M.KS, noise(ks_p=0.01), {"min_ks_distance": 0.02}, ACCEPTED, []),
    (M.KS, noise(ks_p=0.01, ks_stat=0.0201), {"min_ks_distance": 0.02}, REJECTED, [C.KS_REJECTED]),
    (M.KS, noise(num_standardised=20), {}, ACCEPTED, []),
    (M.KS, noise(num_standardised=19, ks_p=0.01), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.KS, noise(num_standardised=19), {"min_observations": 19}, ACCEPTED, []),
    (M.KS, noise(is_fitted=False, ks_p=NAN), {}, UNDETERMINED, [C.NOISE_NOT_FITTED]),
    (M.KS, noise(is_fitted=False, num_standardised=3), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    # verdict_noise
    (M.NOISE, noise(ks_stat=BELOW, ks_p=1e-9), {}, ACCEPTED, []),
    (M.NOISE, noise(ks_stat=ABOVE, ks_p=0.5), {}, REJECTED, [C.NOISE_DIFFERS]),
    *(
        (M.NOISE, sound(noise=noise(ks_stat=0.2).noise, half_pixel=half), {"max_noise_distance": EXCESS}, ACCEPTED, [])
        for half in (False, True)
    ),
    (M.NOISE, noise(ks_stat=ABOVE), {"max_noise_distance": 0.031}, ACCEPTED, []),
    (M.NOISE, noise(ks_stat=BELOW), {"max_noise_distance": 0.029}, REJECTED, [C.NOISE_DIFFERS]),
    (M.NOISE, noise(ks_stat=ABOVE, num_standardised=289), {}, ACCEPTED, []),
    (M.NOISE, noise(ks_stat=BELOW, num_standardised=291), {}, REJECTED, [C.NOISE_DIFFERS]),
    (M.NOISE, replace(noise(ks_stat=ABOVE), half_pixel=True), {}, ACCEPTED, [C.PIXEL_CONVENTION]),
    (M.NOISE, replace(noise(ks_stat=BELOW), half_pixel=True), {}, ACCEPTED, []),
    (M.NOISE, noise(num_standardised=20), {}, ACCEPTED, []),
    (M.NOISE, noise(num_standardised=19, ks_stat=0.9), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.NOISE, noise(is_fitted=False, ks_stat=NAN), {}, UNDETERMINED, [C.NOISE_NOT_FITTED]),
    # verdict_misfit
    (M.MISFIT, with_misfit(radial=MATERIAL), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(radial=group(q=0.05, px=0.3)), {}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=group(q=0.0499, px=0.3)), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(radial=group(q=0.02, px=0.3)), {"alpha": 0.01}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=group(q=0.01, px=0.2)), {}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=group(q=0.01, px=0.2001)), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(radial=MATERIAL), {"min_effect": "0.3px"}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=MATERIAL), {"min_effect": "0.59sigma"}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(radial=MATERIAL), {"min_effect": "0.61sigma"}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=MATERIAL, sigma_px=NAN), {"min_effect": "0.59sigma"}, ACCEPTED, []),
    (M.MISFIT, with_misfit(num_tested=20, radial=MATERIAL), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(num_tested=19, radial=MATERIAL), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.MISFIT, sound(misfit=None), {}, UNDETERMINED, []),
    (M.MISFIT, with_misfit(smooth=NOT_TESTED), {}, ACCEPTED, [C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(radial=ABSORBED), {}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=MATERIAL, smooth=NOT_TESTED), {}, REJECTED, [C.MISFIT_RADIAL, C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(**dict.fromkeys(LENS, NOT_TESTED)), {}, UNDETERMINED, [C.MISFIT_NOT_TESTED]),
    *(
        (M.MISFIT, with_misfit(**{g: NOT_TESTED for g in LENS if g != tested}), {}, ACCEPTED, [C.MISFIT_NOT_TESTED])
        for tested in LENS
    ),
    (M.MISFIT, with_misfit(**dict.fromkeys(LENS, ABSORBED)), {}, UNDETERMINED, [C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(**dict.fromkeys(GROUPS, EXCLUDED)), {}, UNDETERMINED, [C.MISFIT_NOT_TESTED]),
    *((M.MISFIT, with_misfit(**{g: MATERIAL}), {}, REJECTED, [C(f"misfit_{g}")]) for g in GROUPS),
    # verdict_misfit: above 2 tau, and where the whole camera is at fault, worth does not matter
    (M.MISFIT, worthless(0.4), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
    (M.MISFIT, worthless(0.401), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worthless(0.401), {"min_effect": "0.3px"}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
    (M.MISFIT, worthless(0.3, smooth=group(q=0.01, px=0.401)), {}, REJECTED, [C.MISFIT_RADIAL]),
    (
        M.MISFIT,
        worthless(0.3, shared=SharedMisfit(MisfitGroup.RADIAL, 0.3, "camera 7")),
        {},
        REJECTED,
        [C.SHARED_CAMERA, C.MISFIT_RADIAL],
    ),
    # verdict_misfit: what it is worth; not known is enough. A shift is not measured by the rotation that takes it up
    *(
        (M.MISFIT, worth_misfit(g, deg=0.0199, focal=0.00099, centre=9.0), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH])
        for g in GROUPS
        if g not in SHIFTS
    ),
    (M.MISFIT, worth_misfit(deg=0.02, focal=0.0), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worth_misfit(deg=0.0, focal=0.001), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worth_misfit(deg=0.0, focal=-0.001), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worth_misfit(deg=0.0, focal=-0.00099), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
    (M.MISFIT, worth_misfit(deg=0.0199, focal=NAN), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
    (M.MISFIT, worth_misfit(deg=0.02, focal=NAN), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worth_misfit(deg=NAN, focal=0.0, centre=0.0), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, worthless(0.3, smooth=group(q=0.01, px=0.4)), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
    *(
        row
        for g in SHIFTS
        for row in (
            (M.MISFIT, worth_misfit(g, deg=9.0, focal=0.00299, centre=0.00099), {}, ACCEPTED, [C.MISFIT_WITHOUT_WORTH]),
            (M.MISFIT, worth_misfit(g, deg=0.0, focal=0.00299, centre=0.001), {}, REJECTED, [C(f"misfit_{g}")]),
            (M.MISFIT, worth_misfit(g, deg=0.0, focal=0.003, centre=0.00099), {}, REJECTED, [C(f"misfit_{g}")]),
            (M.MISFIT, worth_misfit(g, deg=0.0, focal=-0.003, centre=0.00099), {}, REJECTED, [C(f"misfit_{g}")]),
            (M.MISFIT, worth_misfit(g, deg=NAN, focal=0.0, centre=0.0), {}, REJECTED, [C(f"misfit_{g}")]),
        )
    ),
    # verdict_camera: parts that do not fit, before all else
    (M.CAMERA, parts(inconsistent=True), {}, REJECTED, [C.INCONSISTENT]),
    (M.CAMERA, parts(inconsistent=None), {}, ACCEPTED, []),
    (M.CAMERA, replace(parts(inconsistent=True), largest_residual_px=0.0), {}, REJECTED, [C.INCONSISTENT]),
    (M.CAMERA, replace(parts(inconsistent=True), num_inliers=3), {}, REJECTED, [C.INCONSISTENT]),
    (M.CAMERA, replace(parts(inconsistent=True), own=own(step_px=0.3).own), {}, REJECTED, [C.INCONSISTENT]),
    (M.CAMERA, replace(parts(inconsistent=True), own=own(step_px=NAN).own), {}, REJECTED, [C.INCONSISTENT]),
    # verdict_camera: px on both sides of tau, |step| on both sides of 5 sd
    (M.CAMERA, own(step_px=0.2001), {}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    (M.CAMERA, own(step_px=0.2), {}, ACCEPTED, []),
    (M.CAMERA, own(step_px=0.3), {"min_effect": "0.3px"}, ACCEPTED, []),
    (M.CAMERA, own(step_px=0.3), {"min_effect": "0.59sigma"}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    (M.CAMERA, own(step_px=0.3), {"min_effect": "0.61sigma"}, ACCEPTED, []),
    (M.CAMERA, own(step_px=0.3, sigma_px=NAN), {"min_effect": "0.1sigma"}, ACCEPTED, []),
    (M.CAMERA, own(sds=5.0), {}, ACCEPTED, []),
    (M.CAMERA, own(sds=5.001), {}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    (M.CAMERA, own(sds=-5.001), {}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    (M.CAMERA, own(sds=-5.0), {}, ACCEPTED, []),
    (M.CAMERA, own(sds=0.0), {}, ACCEPTED, []),  # weighted and unweighted steps of opposite sign agree on 0
    (
        M.CAMERA,
        sound(own=replace(OWN, step_px=0.3, steps=(FOCAL, moved(6.0, "k")))),
        {},
        REJECTED,
        [C.CAMERA_NOT_OPTIMAL],
    ),
    (
        M.CAMERA,
        sound(own=replace(OWN, step_px=0.3, steps=(replace(FOCAL, sd=NAN), moved(6.0)))),
        {},
        REJECTED,
        [C.CAMERA_NOT_OPTIMAL],
    ),
    (M.CAMERA, sound(own=replace(OWN, step_px=0.3, steps=(replace(FOCAL, step=9.0, sd=0.0),))), {}, ACCEPTED, []),
    (M.CAMERA, sound(own=replace(OWN, step_px=0.3, steps=())), {}, ACCEPTED, []),
    # verdict_camera: not asked, nothing to ask for, cannot be asked
    (M.CAMERA, sound(own=None, has_own=False), {}, ACCEPTED, []),
    (M.CAMERA, sound(own=None), {}, UNDETERMINED, [C.CAMERA_NOT_TESTED]),
    (M.CAMERA, own(step_px=NAN), {}, UNDETERMINED, [C.CAMERA_NOT_TESTED]),
    (M.CAMERA, own(step_px=0.0), {}, ACCEPTED, []),
    (M.CAMERA, replace(own(), num_inliers=20), {}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    (M.CAMERA, replace(own(), num_inliers=19), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.CAMERA, replace(own(), num_inliers=19), {"min_observations": 19}, REJECTED, [C.CAMERA_NOT_OPTIMAL]),
    # all points behind their cameras
    *((m, parts(all_behind=True), {}, UNDETERMINED, [C.POINTS_BEHIND]) for m in M if m is not M.OUTSIDE),
    # verdict_pose
    (M.POSE, sound(pose_offset_px=0.5), {}, ACCEPTED, []),
    (M.POSE, sound(pose_offset_px=0.501), {}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(pose_offset_px=0.501), {"pose_offset_threshold_px": 0.6}, ACCEPTED, []),
    (M.POSE, sound(pose_offset_px=0.3), {"pose_offset_threshold_px": 0.25}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(pose_offset_px=NAN), {}, UNDETERMINED, [C.NON_FINITE_DERIVATIVES]),
    (M.POSE, sound(num_inliers=20, pose_offset_px=3.0), {}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(num_inliers=19, pose_offset_px=3.0), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.POSE, sound(half_pixel=True, pose_offset_px=0.5), {}, ACCEPTED, []),
    (M.POSE, sound(half_pixel=True, pose_offset_px=0.501), {}, ACCEPTED, [C.PIXEL_CONVENTION]),
    (M.POSE, sound(half_pixel=True, pose_offset_px=0.5 + HALF), {}, ACCEPTED, [C.PIXEL_CONVENTION]),
    (M.POSE, sound(half_pixel=True, pose_offset_px=0.501 + HALF), {}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    # plausible
    (M.PLAUSIBLE, camera(focal_over_size=0.3), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(focal_over_size=0.299), {}, REJECTED, [C.FOCAL_OUT_OF_RANGE]),
    (M.PLAUSIBLE, camera(focal_over_size=0.35), {"min_focal_over_size": 0.4}, REJECTED, [C.FOCAL_OUT_OF_RANGE]),
    (M.PLAUSIBLE, camera(focal_over_size=10.0), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(focal_over_size=10.1), {}, REJECTED, [C.FOCAL_OUT_OF_RANGE]),
    (M.PLAUSIBLE, camera(focal_over_size=10.1), {"max_focal_over_size": 11.0}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(focal_over_size=-5.0), {}, REJECTED, [C.FOCAL_OUT_OF_RANGE]),
    (M.PLAUSIBLE, camera(focal_over_size=NAN), {}, REJECTED, [C.FOCAL_OUT_OF_RANGE]),
    (M.PLAUSIBLE, camera(focal_over_size=NAN, principal_point_px=None, has_focal=False), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(folds_over=True), {}, REJECTED, [C.DISTORTION_FOLDS]),
    *(
        (M.PLAUSIBLE, camera(principal_point_px=inside), {}, ACCEPTED, [])
        for inside in ((0.0, 0.0), (1600.0, 1200.0), (1600.0, 600.0))
    ),
    *(
        (M.PLAUSIBLE, camera(principal_point_px=outside), {}, REJECTED, [C.PRINCIPAL_POINT_OUTSIDE])
        for outside in ((-0.1, 600.0), (800.0, -0.1), (1600.1, 600.0), (800.0, 1200.1))
    ),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.005), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.00501), {}, UNDETERMINED, [C.FOCAL_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.00501), {"max_sd_focal_rel": 0.01}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.5, has_focal=False), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN, is_singular=True), {}, UNDETERMINED, [C.FOCAL_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, camera(is_singular=True), {}, ACCEPTED, []),  # the joint system fixes it
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN), {}, UNDETERMINED, [C.NOISE_NOT_FITTED]),
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN, singular_share=NAN), {}, UNDETERMINED, [C.NON_FINITE_DERIVATIVES]),
    (M.PLAUSIBLE, camera(k1=0.002), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(k1=-0.0019), {}, ACCEPTED, [C.K1_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, replace(camera(k1=-0.0019), own=own().own), {}, ACCEPTED, []),  # frozen where it is: wrong, needed
    (M.PLAUSIBLE, replace(camera(k1=-0.0019), own=None), {}, ACCEPTED, [C.K1_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, replace(camera(k1=-0.0019), consistency=None), {}, ACCEPTED, [C.K1_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, replace(camera(coverage=0.0), own=own().own), {}, UNDETERMINED, [C.LOW_COVERAGE]),
    (M.PLAUSIBLE, camera(k1=-0.0019), {"min_k1_sds": 1.8}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_k1=NAN), {}, ACCEPTED, [C.K1_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, camera(k1=None, sd_k1=NAN), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(coverage=0.2), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(coverage=0.199), {}, UNDETERMINED, [C.LOW_COVERAGE]),
    (M.PLAUSIBLE, camera(coverage=0.199), {"min_coverage": 0.1}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(coverage=NAN), {}, UNDETERMINED, [C.LOW_COVERAGE]),
    (M.PLAUSIBLE, camera(occupied_cells=16), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(occupied_cells=15), {}, UNDETERMINED, [C.FEW_OCCUPIED_CELLS]),
    (M.PLAUSIBLE, camera(occupied_cells=15), {"min_occupied_cells": 15}, ACCEPTED, []),
    (M.PLAUSIBLE, sound(num_inliers=20), {}, ACCEPTED, []),
    (M.PLAUSIBLE, sound(num_inliers=19), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.PLAUSIBLE, sound(camera=None), {}, UNDETERMINED, []),
]


def name_of(row):
    member, _, settings, verdict, codes = row
    return f"{member.short}-{verdict}-{'-'.join(codes) or 'nothing'}-{'-'.join(settings) or 'defaults'}"


@pytest.mark.parametrize("row", TABLE, ids=name_of)
def test_the_table(row):
    member, diagnostics, settings, verdict, codes = row
    decision = decide(diagnostics, AuditConfig(**settings))
    judgement = decision.members[member]
    assert (judgement.verdict, [reason.code for reason in judgement.reasons]) == (verdict, codes)
    assert decision.of(member) is verdict
    assert all(reason.member == member for reason in judgement.reasons)


def test_questions_that_were_not_asked_are_not_answered():
    decision = decide(SOUND, AuditConfig())
    assert decision.of(M.OUTSIDE) is None
    assert decision.of(M.KS) == ACCEPTED
    alone = decide(sound(consistency=None, own=None), AuditConfig())
    assert alone.of(M.CAMERA) is None
    assert set(alone.members) == set(M) - {M.CAMERA, M.OUTSIDE}
    assert alone.verdict == ACCEPTED


# policies: every member of every policy

BAD = {
    M.MISFIT: with_misfit(radial=MATERIAL),
    M.CAMERA: own(),
    M.POSE: sound(pose_offset_px=2.0),
    M.PLAUSIBLE: camera(folds_over=True),
    M.NOISE: noise(ks_stat=ABOVE),
    M.KS: noise(ks_p=0.01),
}
UNKNOWN = {
    M.MISFIT: with_misfit(num_tested=3),
    M.CAMERA: sound(own=None),
    M.POSE: sound(pose_offset_px=NAN),
    M.PLAUSIBLE: camera(coverage=0.0),
}
DECIDES = {
    "standard": {M.MISFIT, M.CAMERA, M.POSE, M.PLAUSIBLE, M.NOISE, M.OUTSIDE},
    "camera": {M.MISFIT, M.CAMERA, M.POSE, M.PLAUSIBLE},
    "full": set(M),
    "paper": {M.KS},
}


def test_the_default_policy_is_standard():
    assert AuditConfig().policy == "standard"
    assert set(DECIDES) == set(POLICIES)


@pytest.mark.parametrize("policy", DECIDES)
@pytest.mark.parametrize(("wrong", "verdict"), [*((m, REJECTED) for m in BAD), *((m, UNDETERMINED) for m in UNKNOWN)])
def test_a_policy_is_its_members(policy, wrong, verdict):
    found = (BAD if verdict is REJECTED else UNKNOWN)[wrong]
    decision = decide(found, AuditConfig(policy=policy))
    decides = wrong in DECIDES[policy]
    assert decision.verdict == (verdict if decides else ACCEPTED)
    assert {reason.member for reason in decision.reasons} == ({wrong} if decides else set())
    assert [reason.member for reason in decision.all_reasons] == [wrong]
    assert {m for m in M if decision.of(m) not in {ACCEPTED, None}} == {wrong}
    for other, members in DECIDES.items():
        assert decision.under(other).verdict == (verdict if wrong in members else ACCEPTED)
        row = {member: decision.of(member) for member in M}
        assert verdict_under(other, row) == decision.under(other).verdict


@pytest.mark.parametrize("policy", DECIDES)
@pytest.mark.parametrize("wrong", M)
def test_a_row_of_a_finished_run_is_counted_by_the_same_members(policy, wrong):
    row = {**dict.fromkeys(map(str, M), "accepted"), str(wrong): "rejected"}
    assert verdict_under(policy, row) == (REJECTED if wrong in DECIDES[policy] else ACCEPTED)


@pytest.mark.parametrize(
    ("verdicts", "said"),
    [
        ([], UNDETERMINED),
        ([None], UNDETERMINED),
        ([ACCEPTED, None], ACCEPTED),
        ([ACCEPTED, UNDETERMINED], UNDETERMINED),
        ([UNDETERMINED, REJECTED, ACCEPTED], REJECTED),
        (["accepted", "rejected"], REJECTED),
        (["accepted", "a word of a later version"], UNDETERMINED),
    ],
)
def test_one_rejection_rejects_and_undetermined_is_no_pass(verdicts, said):
    assert strongest(verdicts) is said


def test_who_was_not_asked_by_a_policy_is_undetermined():
    verdicts = (REJECTED, ACCEPTED, UNDETERMINED)
    members = {member: Judged(np.full(4, NOT_ASKED), ()) for member in M}
    members[M.KS] = Judged(np.array([*(VERDICTS.index(each) for each in verdicts), NOT_ASKED]), ())
    found = replace(decide_all(Measured.of([SOUND] * 4), AuditConfig(policy="paper")), members=members)
    assert [VERDICTS[place] for place in found.verdict] == [*verdicts, UNDETERMINED]
    assert [VERDICTS[place] for place in found.under("standard")] == [UNDETERMINED] * 4
