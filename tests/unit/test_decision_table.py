"""Every branch and every setting of the decision, values just on both sides of each limit (method.md section 7).

A line of audit/decision that can be deleted or changed without a red test here is not finished:
scripts/mutate_decision.py changes them one by one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide
from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    Diagnostics,
    GroupDiagnostics,
    MisfitDiagnostics,
    NoiseDiagnostics,
    SharedMisfit,
)
from sfm_audit.audit.table.words import (
    GROUPS,
    POLICIES,
    REASONS,
    Member,
    MisfitGroup,
    MisfitStatus,
    Reason,
    ReasonCode,
    Verdict,
)

ACCEPTED, REJECTED, UNDETERMINED = Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED
G, C, M, S = MisfitGroup, ReasonCode, Member, MisfitStatus
NAN = math.nan


def group(q=0.5, px=0.01, gain=0.0, status=S.TESTED):
    return GroupDiagnostics(q, px, gain, status)


def misfit(*, num_tested=300, sigma_px=0.5, shared=None, **groups):
    return MisfitDiagnostics({g: groups.get(g, group()) for g in GROUPS}, num_tested, sigma_px, shared)


CAMERA = CameraDiagnostics(
    focal_over_size=0.8,
    folds_over=False,
    principal_point_px=(800.0, 600.0),
    principal_point_outside=False,
    size_px=(1600, 1200),
    coverage=0.5,
    occupied_cells=40,
    has_focal=True,
    sd_focal_rel=0.001,
    singular_share=0.1,
    is_singular=False,
    k1=0.05,
    sd_k1=0.001,
)
NOISE = NoiseDiagnostics(num_standardised=290, num_values=580, ks_stat=0.02, ks_p=0.5, is_fitted=True)
SOUND = Diagnostics(
    num_inliers=300,
    noise=NOISE,
    pose_offset_px=0.01,
    misfit=misfit(),
    camera=CAMERA,
    largest_residual_px=2.0,
    longer_side_px=1600,
)


def noise(**changes):
    return replace(SOUND, noise=replace(NOISE, **changes))


def with_misfit(**changes):
    return replace(SOUND, misfit=misfit(**changes))


def camera(**changes):
    return replace(SOUND, camera=replace(CAMERA, **changes))


def sound(**changes):
    return replace(SOUND, **changes)


MATERIAL = group(q=0.01, px=0.3, gain=10.0)
NOT_TESTED = group(q=NAN, px=NAN, gain=-math.inf, status=S.NOT_ENOUGH_EVIDENCE)
ABSORBED = group(q=NAN, px=NAN, gain=-math.inf, status=S.ABSORBED)
LENS = (G.RADIAL, G.TANGENTIAL, G.AFFINE, G.PRINCIPAL_POINT)

# member, diagnostics, settings, verdict, codes
TABLE = [
    # a sound image
    *((member, SOUND, {}, ACCEPTED, []) for member in (M.MISFIT, M.POSE, M.PLAUSIBLE, M.KS)),
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
    (M.KS, sound(largest_residual_px=1e-7), {}, UNDETERMINED, [C.EXACT_PROJECTIONS]),
    (M.KS, sound(largest_residual_px=1e-4), {}, ACCEPTED, []),
    (M.KS, sound(largest_residual_px=NAN), {}, ACCEPTED, []),
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
    (M.MISFIT, with_misfit(num_tested=20, radial=MATERIAL), {}, REJECTED, [C.MISFIT_RADIAL]),
    (M.MISFIT, with_misfit(num_tested=19, radial=MATERIAL), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.MISFIT, sound(largest_residual_px=1e-7), {}, UNDETERMINED, [C.EXACT_PROJECTIONS]),
    (M.MISFIT, sound(misfit=None, num_inliers=0), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
    (M.MISFIT, with_misfit(smooth=NOT_TESTED), {}, ACCEPTED, [C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(radial=ABSORBED), {}, ACCEPTED, []),
    (M.MISFIT, with_misfit(radial=MATERIAL, smooth=NOT_TESTED), {}, REJECTED, [C.MISFIT_RADIAL, C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(**dict.fromkeys(LENS, NOT_TESTED)), {}, UNDETERMINED, [C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(**dict.fromkeys(LENS[1:], NOT_TESTED)), {}, ACCEPTED, [C.MISFIT_NOT_TESTED]),
    (M.MISFIT, with_misfit(**dict.fromkeys(LENS, ABSORBED)), {}, UNDETERMINED, [C.MISFIT_NOT_TESTED]),
    *((M.MISFIT, with_misfit(**{g: MATERIAL}), {}, REJECTED, [C(f"misfit_{g}")]) for g in GROUPS),
    # verdict_pose
    (M.POSE, sound(pose_offset_px=0.5), {}, ACCEPTED, []),
    (M.POSE, sound(pose_offset_px=0.501), {}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(pose_offset_px=0.501), {"pose_offset_threshold_px": 0.6}, ACCEPTED, []),
    (M.POSE, sound(pose_offset_px=0.3), {"pose_offset_threshold_px": 0.25}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(pose_offset_px=NAN), {}, UNDETERMINED, [C.NON_FINITE_DERIVATIVES]),
    (M.POSE, sound(num_inliers=20, pose_offset_px=3.0), {}, REJECTED, [C.POSE_NOT_OPTIMAL]),
    (M.POSE, sound(num_inliers=19, pose_offset_px=3.0), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
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
    (M.PLAUSIBLE, camera(principal_point_outside=True), {}, REJECTED, [C.PRINCIPAL_POINT_OUTSIDE]),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.01), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.0101), {}, UNDETERMINED, [C.FOCAL_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.0101), {"max_sd_focal_rel": 0.02}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=0.5, has_focal=False), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN, is_singular=True), {}, UNDETERMINED, [C.FOCAL_NOT_IDENTIFIED]),
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN), {}, UNDETERMINED, [C.NOISE_NOT_FITTED]),
    (M.PLAUSIBLE, camera(sd_focal_rel=NAN, singular_share=NAN), {}, UNDETERMINED, [C.NON_FINITE_DERIVATIVES]),
    (M.PLAUSIBLE, camera(k1=0.0021), {}, ACCEPTED, []),
    (M.PLAUSIBLE, camera(k1=-0.0019), {}, ACCEPTED, [C.K1_NOT_IDENTIFIED]),
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
    (M.PLAUSIBLE, sound(num_inliers=0, camera=None), {}, UNDETERMINED, [C.TOO_FEW_OBSERVATIONS]),
]


def name_of(row):
    member, _, settings, verdict, codes = row
    return f"{member.short}-{verdict}-{'-'.join(codes) or 'nothing'}-{'-'.join(settings) or 'defaults'}"


@pytest.mark.parametrize("row", TABLE, ids=name_of)
def test_the_table(row):
    member, diagnostics, settings, verdict, codes = row
    judgement = decide(diagnostics, AuditConfig(**settings)).members[member]
    assert (judgement.verdict, [reason.code for reason in judgement.reasons]) == (verdict, codes)
    assert all(reason.member == member for reason in judgement.reasons)


# which reasons stand together, and in which order


def test_plausible_lists_everything_and_one_rejection_rejects():
    found = camera(
        focal_over_size=0.1, folds_over=True, sd_focal_rel=0.5, coverage=0.01, occupied_cells=1, k1=0.0, sd_k1=1.0
    )
    judgement = decide(found, AuditConfig()).members[M.PLAUSIBLE]
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [
        C.FOCAL_OUT_OF_RANGE,
        C.DISTORTION_FOLDS,
        C.FOCAL_NOT_IDENTIFIED,
        C.LOW_COVERAGE,
        C.FEW_OCCUPIED_CELLS,
        C.K1_NOT_IDENTIFIED,
    ]
    few = replace(found, num_inliers=3)
    judgement = decide(few, AuditConfig()).members[M.PLAUSIBLE]
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [
        C.FOCAL_OUT_OF_RANGE,
        C.DISTORTION_FOLDS,
        C.TOO_FEW_OBSERVATIONS,
    ]


def test_remarks_found_elsewhere_decide_nothing():
    remark = Reason(C.FRONTO_PARALLEL, M.PLAUSIBLE, "tilt 1 deg")
    judgement = decide(sound(remarks=(remark,)), AuditConfig()).members[M.PLAUSIBLE]
    assert (judgement.verdict, judgement.reasons) == (ACCEPTED, (remark,))


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
    assert (
        str(decision.members[M.MISFIT].reasons[0]) == "misfit_rolling_shutter: 0.25 px, q = 0.02 (also radial 0.30 px)"
    )


def test_a_cause_below_tau_is_named_and_rejects_nothing():
    found = with_misfit(radial=group(q=0.01, px=0.1, gain=5.0), smooth=group(q=0.01, px=0.15, gain=1.0))
    decision = decide(found, AuditConfig())
    assert (decision.misfit.group, decision.misfit.px, decision.misfit.material) == (G.RADIAL, 0.1, ())
    assert decision.of(M.MISFIT) == ACCEPTED


def test_no_significant_group_has_no_cause():
    decision = decide(SOUND, AuditConfig())
    assert decision.misfit.group is None
    assert math.isnan(decision.misfit.px)
    assert math.isnan(decision.misfit.q)


def test_a_shared_camera_is_named_beside_a_rejection_and_only_there():
    shared = SharedMisfit(7, 12, G.TANGENTIAL, 0.41, 1e-9)
    rejected = decide(with_misfit(radial=MATERIAL, shared=shared), AuditConfig()).members[M.MISFIT]
    assert [reason.code for reason in rejected.reasons] == [C.SHARED_CAMERA, C.MISFIT_RADIAL]
    assert str(rejected.reasons[0]) == "shared_camera: camera 7, 12 images: tangential 0.41 px, q = 1e-09"
    accepted = decide(with_misfit(shared=shared), AuditConfig()).members[M.MISFIT]
    assert (accepted.verdict, accepted.reasons) == (ACCEPTED, ())
    unknown = decide(with_misfit(num_tested=3, radial=MATERIAL, shared=shared), AuditConfig()).members[M.MISFIT]
    assert (unknown.verdict, len(unknown.reasons)) == (UNDETERMINED, 1)


# what reasons say


@pytest.mark.parametrize(
    ("diagnostics", "member", "said"),
    [
        (noise(ks_p=0.01), M.KS, "ks_rejected: p = 0.01 < 0.05, D = 0.0200, 580 values"),
        (noise(num_standardised=3), M.KS, "too_few_observations: 3 standardised of 300 inliers, 20 needed"),
        (noise(is_fitted=False), M.KS, "noise_not_fitted: 290 observations"),
        (sound(num_inliers=3, noise=replace(NOISE, num_standardised=3)), M.KS, "3 inliers, 20 needed"),
        (with_misfit(num_tested=3), M.MISFIT, "too_few_observations: 3 clean of 300 inliers, 20 needed"),
        (sound(misfit=misfit(num_tested=3), num_inliers=3), M.MISFIT, "3 inliers, 20 needed"),
        (sound(misfit=None, num_inliers=7), M.MISFIT, "7 inliers, 20 needed"),
        (with_misfit(smooth=NOT_TESTED, affine=NOT_TESTED), M.MISFIT, "affine (not enough evidence), smooth (not"),
        (with_misfit(**dict.fromkeys(GROUPS, ABSORBED)), M.MISFIT, "misfit_not_tested: no group left"),
        (sound(pose_offset_px=1.2345), M.POSE, "pose_not_optimal: pose_offset_px = 1.23 > 0.5"),
        (sound(pose_offset_px=NAN), M.POSE, "non_finite_derivatives: pose offset unknown, 300 inliers"),
        (camera(focal_over_size=0.1), M.PLAUSIBLE, "f / max(w, h) = 0.1, outside [0.3, 10]"),
        (camera(folds_over=True), M.PLAUSIBLE, "inside the image of 1600 x 1200 px"),
        (
            camera(principal_point_px=(-1.0, 2.0), principal_point_outside=True),
            M.PLAUSIBLE,
            "(-1.0, 2.0) px, image of 1600 x 1200 px",
        ),
        (camera(sd_focal_rel=0.5), M.PLAUSIBLE, "sd_f / f = 50.00% > 1%, conditional on the points"),
        (camera(is_singular=True, sd_focal_rel=NAN), M.PLAUSIBLE, "smallest / largest singular value = 0.1"),
        (camera(sd_focal_rel=NAN), M.PLAUSIBLE, "noise_not_fitted: 300 observations"),
        (camera(sd_focal_rel=NAN, singular_share=NAN), M.PLAUSIBLE, "covariance unknown, 300 inliers"),
        (camera(coverage=0.1), M.PLAUSIBLE, "low_coverage: 10.0% < 20% of the image"),
        (camera(occupied_cells=3), M.PLAUSIBLE, "few_occupied_cells: 3 < 16"),
        (camera(k1=0.001, sd_k1=0.002), M.PLAUSIBLE, "k1_not_identified: 0.001, sd = 0.002"),
        (sound(largest_residual_px=1e-8), M.KS, "exact_projections: largest residual 1e-08 px"),
    ],
)
def test_reasons_carry_their_numbers(diagnostics, member, said):
    (reason,) = decide(diagnostics, AuditConfig()).members[member].reasons
    assert said in str(reason)


@pytest.mark.parametrize(
    ("diagnostics", "member", "numbers"),
    [
        (noise(ks_p=0.01), M.KS, (0.01, 0.05, "1", None)),
        (noise(num_standardised=3), M.KS, (3, 20, "count", None)),
        (with_misfit(affine=MATERIAL), M.MISFIT, (0.3, 0.2, "px", G.AFFINE)),
        (sound(pose_offset_px=1.2), M.POSE, (1.2, 0.5, "px", None)),
        (camera(focal_over_size=0.1), M.PLAUSIBLE, (0.1, 0.3, "1", None)),
        (camera(focal_over_size=11.0), M.PLAUSIBLE, (11.0, 10.0, "1", None)),
        (camera(sd_focal_rel=0.5), M.PLAUSIBLE, (0.5, 0.01, "1", None)),
        (camera(coverage=0.1), M.PLAUSIBLE, (0.1, 0.2, "1", None)),
        (camera(occupied_cells=3), M.PLAUSIBLE, (3, 16, "count", None)),
        (sound(largest_residual_px=1e-8), M.MISFIT, (1e-8, pytest.approx(1.6e-6), "px", None)),
    ],
)
def test_reasons_are_records(diagnostics, member, numbers):
    reason = decide(diagnostics, AuditConfig()).members[member].reasons[0]
    assert (reason.value, reason.limit, reason.unit, reason.group) == numbers


# policies


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("wrong", [M.KS, M.MISFIT, M.POSE, M.PLAUSIBLE])
def test_a_policy_is_its_members(policy, wrong):
    bad = {
        M.KS: noise(ks_p=0.01),
        M.MISFIT: with_misfit(radial=MATERIAL),
        M.POSE: sound(pose_offset_px=2.0),
        M.PLAUSIBLE: camera(folds_over=True),
    }
    decision = decide(bad[wrong], AuditConfig(policy=policy))
    assert decision.verdict == (REJECTED if wrong in POLICIES[policy] else ACCEPTED)
    assert {reason.member for reason in decision.reasons} == ({wrong} & set(POLICIES[policy]))
    assert [reason.member for reason in decision.all_reasons] == [wrong]


def test_a_policy_lists_each_reason_once_in_the_order_of_its_members():
    nothing = sound(num_inliers=3, noise=replace(NOISE, num_standardised=3), misfit=misfit(num_tested=3))
    decision = decide(nothing, AuditConfig(policy="full"))
    assert decision.verdict == UNDETERMINED
    assert [str(reason) for reason in decision.reasons] == ["too_few_observations: 3 inliers, 20 needed"]
    assert decision.reasons[0].member == M.MISFIT
    everything = replace(noise(ks_p=0.01), pose_offset_px=2.0, misfit=misfit(radial=MATERIAL))
    codes = [reason.code for reason in decide(everything, AuditConfig(policy="full")).reasons]
    assert codes == [C.MISFIT_RADIAL, C.POSE_NOT_OPTIMAL, C.KS_REJECTED]


def test_an_unusable_image_is_undetermined_in_every_question_that_is_asked():
    why = Reason(C.MISSING_CAMERA, M.MISFIT, "camera 7")
    unusable = sound(unusable=why, misfit=misfit(radial=MATERIAL), pose_offset_px=9.0)
    decision = decide(unusable, AuditConfig(policy="full"))
    assert decision.verdict == UNDETERMINED
    assert [str(reason) for reason in decision.reasons] == ["missing_camera: camera 7"]
    for member, judgement in decision.members.items():
        assert (judgement.verdict, judgement.reasons) == (UNDETERMINED, (replace(why, member=member),))


def test_questions_that_were_not_asked_are_not_answered():
    decision = decide(SOUND, AuditConfig())
    assert decision.of(M.OUTSIDE) is None
    assert decision.of(M.KS) == ACCEPTED


# words


def test_every_reason_has_words():
    assert set(REASONS) == set(ReasonCode)
    assert all(words.meaning and words.members for words in REASONS.values())
