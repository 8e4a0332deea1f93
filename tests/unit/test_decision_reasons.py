"""What the reasons of a decision say, which stand together, and in which order."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from decision_samples import (
    ABSORBED,
    EXACT_PX,
    EXCLUDED,
    MATERIAL,
    NAN,
    NOISE,
    NOT_TESTED,
    OWN,
    camera,
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
from sfm_audit.audit.decision.diagnostics import Gains, SharedMisfit
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.table.words import (
    GROUPS,
    MISFIT_CODES,
    REASONS,
    Member,
    MisfitGroup,
    Reason,
    ReasonCode,
    Verdict,
    is_remark,
)

ACCEPTED, REJECTED, UNDETERMINED = Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED
G, C, M = MisfitGroup, ReasonCode, Member
WRONG = "pose or camera wrong otherwise"
SHARED = SharedMisfit.of(7, 12, G.TANGENTIAL, 0.41, 1e-9)


def judged(diagnostics, member, **settings):
    return decide(diagnostics, AuditConfig(**settings)).members[member]


@pytest.mark.parametrize(
    ("diagnostics", "member", "said"),
    [
        (noise(ks_p=0.01), M.KS, "ks_rejected: p = 0.01 < 0.05, D = 0.0200, 580 values"),
        (noise(num_standardised=3), M.KS, "too_few_observations: 3 standardised of 300 inliers, 20 needed"),
        (noise(is_fitted=False), M.KS, "noise_not_fitted: 290 observations"),
        (noise(num_inliers=3, num_standardised=3), M.KS, "too_few_observations: 3 inliers, 20 needed"),
        (noise(ks_stat=0.2), M.NOISE, "noise_differs: D - 1.36 / sqrt(N) = 0.144 > 0.03, N = 580"),
        (
            replace(noise(ks_stat=0.2), half_pixel=True),
            M.NOISE,
            "pixel_convention: D - 1.36 / sqrt(N) = 0.144 > 0.03, N = 580",
        ),
        (with_misfit(num_tested=3), M.MISFIT, "too_few_observations: 3 of 300 inliers tested, 20 needed"),
        (sound(misfit=misfit(num_tested=3), num_inliers=3), M.MISFIT, "too_few_observations: 3 inliers, 20 needed"),
        (sound(misfit=None, num_inliers=7), M.MISFIT, "too_few_observations: 7 inliers, 20 needed"),
        (
            with_misfit(smooth=NOT_TESTED, affine=NOT_TESTED),
            M.MISFIT,
            "misfit_not_tested: affine (not enough evidence), smooth (not enough evidence)",
        ),
        (with_misfit(**dict.fromkeys(GROUPS, ABSORBED)), M.MISFIT, "misfit_not_tested: no group left"),
        (
            with_misfit(**dict.fromkeys(GROUPS, EXCLUDED)),
            M.MISFIT,
            f"misfit_not_tested: all groups ({WRONG})",
        ),
        (
            with_misfit(**{**dict.fromkeys(GROUPS, EXCLUDED), "radial": NOT_TESTED}),
            M.MISFIT,
            f"misfit_not_tested: radial (not enough evidence), {', '.join(f'{g} ({WRONG})' for g in GROUPS[1:])}",
        ),
        (
            with_misfit(**{**dict.fromkeys(GROUPS, NOT_TESTED), "radial": ABSORBED}),
            M.MISFIT,
            f"misfit_not_tested: {', '.join(f'{g} (not enough evidence)' for g in GROUPS[1:])}",
        ),
        (
            worth_misfit("smooth", deg=0.0123, focal=-0.0005, centre=0.002),
            M.MISFIT,
            "misfit_without_worth: smooth 0.30 px, worth 0.012 degrees, 0.002 of the depth, -0.0005 of f",
        ),
        (
            worth_misfit("smooth", deg=0.0123, focal=NAN, centre=0.002),
            M.MISFIT,
            "misfit_without_worth: smooth 0.30 px, worth 0.012 degrees, 0.002 of the depth",
        ),
        (with_misfit(radial=MATERIAL), M.MISFIT, "misfit_radial: 0.30 px, q = 0.01"),
        (parts(inconsistent=True, text="scale 1000", rms_px=88.0), M.CAMERA, "inconsistent: scale 1000"),
        (parts(all_behind=True, text="all 300 behind"), M.CAMERA, "points_behind: all 300 behind"),
        (
            own(step_px=0.43, sds=40.0),
            M.CAMERA,
            "camera_not_optimal: f = 1000 stored, 1080 +- 2 implied (+8.0% +- 0.2%), 0.43 px",
        ),
        (
            own(step_px=0.43, sds=-40.0, num_images=2),
            M.CAMERA,
            "camera_not_optimal: f = 1000 stored, 920 +- 2 implied (-8.0% +- 0.2%), 0.43 px, 2 images",
        ),
        (
            sound(own=replace(OWN, step_px=0.3, steps=(moved(6.0, "k"),))),
            M.CAMERA,
            "camera_not_optimal: k = 1000 stored, 1012 +- 2 implied, 0.30 px",
        ),
        (
            sound(own=replace(OWN, step_px=0.3, steps=(replace(moved(6.0), stored=0.0),))),
            M.CAMERA,
            "camera_not_optimal: f = 0 stored, 1012 +- 2 implied, 0.30 px",
        ),
        (
            sound(own=replace(OWN, step_px=0.3, steps=(replace(moved(6.0), stored=-1000.0, implied=-1080.0),))),
            M.CAMERA,
            "camera_not_optimal: f = -1000 stored, -1080 +- 2 implied (+8.0% +- 0.2%), 0.30 px",
        ),
        (sound(own=None), M.CAMERA, "camera_not_tested: 300 inliers"),
        (sound(pose_offset_px=1.2345), M.POSE, "pose_not_optimal: pose_offset_px = 1.23 > 0.5"),
        (
            sound(pose_offset_px=1.1, half_pixel=True),
            M.POSE,
            "pixel_convention: pose_offset_px = 1.1, of which half a pixel in x and y explains 0.71",
        ),
        (sound(pose_offset_px=NAN), M.POSE, "non_finite_derivatives: pose offset unknown, 300 inliers"),
        (camera(focal_over_size=0.1), M.PLAUSIBLE, "focal_out_of_range: f / max(w, h) = 0.1, outside [0.3, 10]"),
        (camera(folds_over=True), M.PLAUSIBLE, "distortion_folds: inside the image of 1600 x 1200 px"),
        (
            camera(principal_point_px=(-1.0, 2.0)),
            M.PLAUSIBLE,
            "principal_point_outside: (-1.0, 2.0) px, image of 1600 x 1200 px",
        ),
        (camera(sd_focal_rel=0.5), M.PLAUSIBLE, "focal_not_identified: sd_f / f = 50.00% > 0.50%"),
        (
            camera(sd_focal_rel=0.5, is_joint=False),
            M.PLAUSIBLE,
            "focal_not_identified: sd_f / f = 50.00% > 0.50%, conditional on the points",
        ),
        (
            camera(is_singular=True, sd_focal_rel=NAN),
            M.PLAUSIBLE,
            "focal_not_identified: smallest / largest singular value = 0.1",
        ),
        (camera(sd_focal_rel=NAN), M.PLAUSIBLE, "noise_not_fitted: 300 observations"),
        (
            camera(sd_focal_rel=NAN, singular_share=NAN),
            M.PLAUSIBLE,
            "non_finite_derivatives: covariance unknown, 300 inliers",
        ),
        (camera(coverage=0.1), M.PLAUSIBLE, "low_coverage: 10.0% < 20% of the image"),
        (camera(occupied_cells=3), M.PLAUSIBLE, "few_occupied_cells: 3 < 16"),
        (
            camera(k1=0.001, sd_k1=0.002, is_joint=False),
            M.PLAUSIBLE,
            "k1_not_identified: 0.001, sd = 0.002, conditional on the points",
        ),
        (camera(k1=0.001, sd_k1=0.002), M.PLAUSIBLE, "k1_not_identified: 0.001, sd = 0.002"),
        (sound(num_inliers=4), M.PLAUSIBLE, "too_few_observations: 4 inliers, 20 needed"),
        (sound(num_inliers=4, camera=None), M.PLAUSIBLE, "too_few_observations: 4 inliers, 20 needed"),
        (sound(largest_residual_px=1e-8), M.KS, "exact_projections: largest residual 1e-08 px"),
    ],
)
def test_reasons_carry_their_numbers(diagnostics, member, said):
    (reason,) = judged(diagnostics, member).reasons
    assert str(reason) == said


NUMBERS = [
    (noise(ks_p=0.01), M.KS, (0.01, 0.05, "1", None)),
    (noise(num_standardised=3), M.KS, (3, 20, "count", None)),
    (noise(is_fitted=False), M.KS, (290, None, "count", None)),
    (noise(ks_stat=0.2), M.NOISE, (pytest.approx(0.2 - 1.36 / math.sqrt(580)), 0.03, "1", None)),
    (with_misfit(affine=MATERIAL), M.MISFIT, (0.3, 0.2, "px", G.AFFINE)),
    (with_misfit(affine=MATERIAL, shared=SHARED), M.MISFIT, (0.41, 0.2, "px", G.TANGENTIAL)),
    (worth_misfit("smooth", deg=0.0, focal=0.0), M.MISFIT, (0.3, 0.2, "px", G.SMOOTH)),
    (with_misfit(smooth=NOT_TESTED), M.MISFIT, (None, None, "", None)),
    (parts(inconsistent=True, rms_px=88.0), M.CAMERA, (88.0, None, "px", None)),
    (own(step_px=0.43), M.CAMERA, (0.43, 0.2, "px", None)),
    (sound(own=None), M.CAMERA, (300, None, "count", None)),
    (sound(pose_offset_px=1.2), M.POSE, (1.2, 0.5, "px", None)),
    (sound(pose_offset_px=1.2, half_pixel=True), M.POSE, (1.2, 0.5, "px", None)),
    (sound(pose_offset_px=NAN), M.POSE, (300, None, "count", None)),
    (camera(focal_over_size=0.1), M.PLAUSIBLE, (0.1, 0.3, "1", None)),
    (camera(focal_over_size=11.0), M.PLAUSIBLE, (11.0, 10.0, "1", None)),
    (camera(sd_focal_rel=0.5), M.PLAUSIBLE, (0.5, 0.005, "1", None)),
    (camera(sd_focal_rel=NAN, is_singular=True), M.PLAUSIBLE, (0.1, None, "1", None)),
    (camera(sd_focal_rel=NAN), M.PLAUSIBLE, (300, None, "count", None)),
    (camera(coverage=0.1), M.PLAUSIBLE, (0.1, 0.2, "1", None)),
    (camera(occupied_cells=3), M.PLAUSIBLE, (3, 16, "count", None)),
    (camera(k1=0.001, sd_k1=0.002), M.PLAUSIBLE, (0.001, 0.002, "1", None)),
    (sound(largest_residual_px=1e-8), M.MISFIT, (1e-8, pytest.approx(EXACT_PX), "px", None)),
]


@pytest.mark.parametrize(("diagnostics", "member", "numbers"), NUMBERS)
def test_reasons_are_records(diagnostics, member, numbers):
    reason = judged(diagnostics, member).reasons[0]
    assert (reason.value, reason.limit, reason.unit, reason.group) == numbers
    assert reason.verdict == member


# which reasons stand together, and in which order


def test_plausible_lists_everything_and_one_rejection_rejects():
    remark = Reason(C.FRONTO_PARALLEL, M.PLAUSIBLE, "tilt 1 deg")
    found = camera(
        focal_over_size=0.1, folds_over=True, sd_focal_rel=0.5, coverage=0.01, occupied_cells=1, k1=0.0, sd_k1=1.0
    )
    judgement = judged(replace(found, remarks=(remark,)), M.PLAUSIBLE)
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [
        C.FOCAL_OUT_OF_RANGE,
        C.DISTORTION_FOLDS,
        C.FOCAL_NOT_IDENTIFIED,
        C.LOW_COVERAGE,
        C.FEW_OCCUPIED_CELLS,
        C.K1_NOT_IDENTIFIED,
        C.FRONTO_PARALLEL,
    ]
    judgement = judged(replace(found, num_inliers=3), M.PLAUSIBLE)
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [
        C.FOCAL_OUT_OF_RANGE,
        C.DISTORTION_FOLDS,
        C.TOO_FEW_OBSERVATIONS,
    ]


def test_remarks_found_elsewhere_decide_nothing():
    remark = Reason(C.FRONTO_PARALLEL, M.PLAUSIBLE, "tilt 1 deg")
    judgement = judged(sound(remarks=(remark,)), M.PLAUSIBLE)
    assert (judgement.verdict, judgement.reasons) == (ACCEPTED, (remark,))


def test_a_shared_camera_is_named_beside_a_rejection_and_only_there():
    rejected = judged(with_misfit(radial=MATERIAL, smooth=NOT_TESTED, shared=SHARED), M.MISFIT)
    assert [reason.code for reason in rejected.reasons] == [C.SHARED_CAMERA, C.MISFIT_RADIAL, C.MISFIT_NOT_TESTED]
    assert str(rejected.reasons[0]) == "shared_camera: camera 7, 12 images: tangential 0.41 px, q = 1e-09"
    accepted = judged(with_misfit(shared=SHARED), M.MISFIT)
    assert (accepted.verdict, accepted.reasons) == (ACCEPTED, ())
    unknown = judged(with_misfit(num_tested=3, radial=MATERIAL, shared=SHARED), M.MISFIT)
    assert (unknown.verdict, len(unknown.reasons)) == (UNDETERMINED, 1)


def test_a_misfit_without_worth_is_a_remark_beside_what_could_not_be_tested():
    cheap = replace(MATERIAL, worth=worth(deg=0.0, focal=0.0))
    judgement = judged(with_misfit(radial=cheap, smooth=NOT_TESTED), M.MISFIT)
    assert judgement.verdict == ACCEPTED
    assert [reason.code for reason in judgement.reasons] == [C.MISFIT_WITHOUT_WORTH, C.MISFIT_NOT_TESTED]
    judgement = judged(with_misfit(radial=cheap, shared=SHARED), M.MISFIT)
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [C.SHARED_CAMERA, C.MISFIT_RADIAL]


def test_a_misfit_of_a_shared_camera_rejects_whatever_it_is_worth_to_one_image():
    cheap = replace(MATERIAL, worth=worth(deg=0.0, focal=0.0))
    judgement = judged(with_misfit(radial=cheap, shared=SHARED), M.MISFIT)
    assert judgement.verdict == REJECTED
    assert [reason.code for reason in judgement.reasons] == [C.SHARED_CAMERA, C.MISFIT_RADIAL]


def test_the_camera_names_the_parameter_that_moves_most_of_its_deviations():
    steps = (moved(6.0), replace(moved(-9.0, "k1"), step=-0.9, sd=0.1), moved(8.0, "k2"))
    judgement = judged(sound(own=replace(OWN, step_px=0.3, steps=steps)), M.CAMERA)
    assert judgement.reasons[0].text.startswith("k1 = ")


EVERYTHING = replace(noise(ks_p=0.01, ks_stat=0.2), pose_offset_px=2.0, misfit=misfit(radial=MATERIAL), own=own().own)


@pytest.mark.parametrize(
    ("policy", "codes"),
    [
        ("full", [C.MISFIT_RADIAL, C.CAMERA_NOT_OPTIMAL, C.POSE_NOT_OPTIMAL, C.NOISE_DIFFERS, C.KS_REJECTED]),
        ("standard", [C.MISFIT_RADIAL, C.CAMERA_NOT_OPTIMAL, C.POSE_NOT_OPTIMAL, C.NOISE_DIFFERS]),
        ("camera", [C.MISFIT_RADIAL, C.CAMERA_NOT_OPTIMAL, C.POSE_NOT_OPTIMAL]),
        ("paper", [C.KS_REJECTED]),
    ],
)
def test_a_policy_lists_the_reasons_of_its_members_in_their_order(policy, codes):
    decision = decide(EVERYTHING, AuditConfig(policy=policy))
    assert [reason.code for reason in decision.reasons] == codes
    assert decision.judgement.reasons == decision.reasons


def test_a_policy_lists_each_reason_once():
    nothing = sound(num_inliers=3, noise=replace(NOISE, num_standardised=3), misfit=misfit(num_tested=3))
    decision = decide(nothing, AuditConfig(policy="full"))
    assert decision.verdict == UNDETERMINED
    assert [str(reason) for reason in decision.reasons] == ["too_few_observations: 3 inliers, 20 needed"]
    assert decision.reasons[0].member == M.MISFIT


@pytest.mark.parametrize(
    ("gains", "first"),
    [
        (Gains(pose=0.9, camera=0.5, both=1.0), True),
        (Gains(pose=0.8999, camera=0.5, both=1.0), False),
        (Gains(pose=0.95, camera=0.8999, both=1.0), True),
        (Gains(pose=0.95, camera=0.9, both=1.0), False),
        (Gains(pose=0.1, camera=0.95, both=1.0), False),
        (Gains(pose=9.5, camera=8.99, both=10.0), True),
        (Gains(pose=9.5, camera=9.01, both=10.0), False),
        (Gains(pose=0.0, camera=-1.0, both=0.0), False),
        (Gains(pose=NAN, camera=NAN, both=NAN), False),
        (None, False),
    ],
)
def test_the_pose_comes_first_where_it_alone_explains_what_both_would_gain(gains, first):
    found = replace(EVERYTHING, gains=gains)
    decision = decide(found, AuditConfig(policy="camera"))
    assert decision.pose_first is first
    codes = [C.MISFIT_RADIAL, C.CAMERA_NOT_OPTIMAL, C.POSE_NOT_OPTIMAL]
    assert [reason.code for reason in decision.reasons] == ([codes[2], *codes[:2]] if first else codes)
    assert decision.under("standard").reasons[0].code == (C.POSE_NOT_OPTIMAL if first else C.MISFIT_RADIAL)
    assert [reason.code for reason in decision.under("paper").reasons] == [C.KS_REJECTED]


@pytest.mark.parametrize("behind", [False, True])
def test_an_unusable_image_is_undetermined_in_every_question_that_is_asked(behind):
    why = Reason(C.MISSING_CAMERA, M.MISFIT, "camera 7")
    unusable = sound(unusable=why, misfit=misfit(radial=MATERIAL), pose_offset_px=9.0)
    if behind:
        unusable = replace(unusable, consistency=parts(all_behind=True).consistency)
    decision = decide(unusable, AuditConfig(policy="full"))
    assert decision.verdict == UNDETERMINED
    assert [str(reason) for reason in decision.reasons] == ["missing_camera: camera 7"]
    assert set(decision.members) == set(M) - {M.OUTSIDE}
    for member, judgement in decision.members.items():
        assert (judgement.verdict, judgement.reasons) == (UNDETERMINED, (replace(why, member=member),))


# words


def test_every_reason_has_words():
    assert set(REASONS) == set(ReasonCode)
    assert all(words.meaning and words.members for words in REASONS.values())
    assert set(MISFIT_CODES) == set(GROUPS)


@pytest.mark.parametrize(
    ("code", "verdict_misfit", "remark"),
    [
        (C.MISFIT_NOT_TESTED, ACCEPTED, True),
        (C.MISFIT_NOT_TESTED, REJECTED, True),
        (C.MISFIT_NOT_TESTED, UNDETERMINED, False),
        (C.K1_NOT_IDENTIFIED, REJECTED, True),
        (C.PIXEL_CONVENTION, ACCEPTED, True),
        (C.KS_REJECTED, ACCEPTED, False),
        (C.LOW_COVERAGE, ACCEPTED, False),
        ("a_code_of_a_later_version", ACCEPTED, False),
    ],
)
def test_remarks_decide_nothing(code, verdict_misfit, remark):
    assert is_remark(code, {M.MISFIT: verdict_misfit}) is remark


def test_each_of_many_images_is_told_its_own_numbers():
    images = [noise(num_inliers=n, num_standardised=m) for n, m in ((300, 3), (200, 3), (300, 4), (300, 3))]
    decisions = decide_all(Measured.of(images), AuditConfig())
    texts = [decisions.decision(i).members[M.KS].reasons[0].text for i in range(4)]
    assert [text.partition(",")[0] for text in texts] == [
        "3 standardised of 300 inliers",
        "3 standardised of 200 inliers",
        "4 standardised of 300 inliers",
        "3 standardised of 300 inliers",
    ]


def test_an_image_that_cannot_be_asked_takes_no_words_from_others():
    odd = Reason(C.MISSING_CAMERA, M.MISFIT, "camera 3")
    decisions = decide_all(Measured.of([replace(noise(ks_p=0.01), unusable=odd), noise(ks_p=0.02)]), AuditConfig())
    assert {reason.code for reason in decisions.decision(0).all_reasons} == {C.MISSING_CAMERA}
    (reason,) = decisions.decision(1).members[M.KS].reasons
    assert (reason.value, reason.text.partition(" <")[0]) == (0.02, "p = 0.02")
