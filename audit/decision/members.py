"""Each question by itself: from diagnostics and settings to accepted, rejected or undetermined, with reasons.

method.md section 7. Every line here that decides is a row of tests/unit/test_decision_table.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import CameraDiagnostics, Diagnostics, Worth
from sfm_audit.audit.decision.misfit import MisfitDecision, is_worth_nothing
from sfm_audit.audit.table.thresholds import EXACT_SHARE, HALF_PIXEL_SHIFT_PX, KS_CRITICAL, MAX_WORTHLESS_TAUS
from sfm_audit.audit.table.words import MISFIT_CODES, Member, MisfitGroup, Reason, ReasonCode, Verdict


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict with the reasons for it; an accepted image may carry remarks that decide nothing."""

    verdict: Verdict
    reasons: tuple[Reason, ...] = ()


def undetermined(*reasons: Reason) -> Judgement:
    """Return that nothing can be said, and why."""
    return Judgement(Verdict.UNDETERMINED, reasons)


def too_few(member: Member, what: str, num: int, settings: AuditConfig) -> Reason | None:
    """Return the reason that ``num`` observations are too few; None where they are enough."""
    if num >= settings.min_observations:
        return None
    text = f"{num} {what}, {settings.min_observations} needed"
    return Reason(ReasonCode.TOO_FEW_OBSERVATIONS, member, text, num, settings.min_observations, "count")


def exact_projections(member: Member, diagnostics: Diagnostics) -> Reason | None:
    """Return what makes the 2D points no measurements; None where they are."""
    limit = EXACT_SHARE * diagnostics.longer_side_px
    if not diagnostics.num_inliers or not diagnostics.largest_residual_px <= limit:
        return None
    text = f"largest residual {diagnostics.largest_residual_px:.2g} px"
    return Reason(ReasonCode.EXACT_PROJECTIONS, member, text, diagnostics.largest_residual_px, limit, "px")


def judge_ks(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement:
    """The paper's decision: rejected when ks_p < alpha; and, where asked for, D is larger than ``min_ks_distance``."""
    noise = diagnostics.noise
    unknown = _no_standardised(Member.KS, diagnostics, settings)
    if unknown is not None:
        return undetermined(unknown)
    if noise.ks_p < settings.alpha and noise.ks_stat > settings.min_ks_distance:
        text = f"p = {noise.ks_p:.3g} < {settings.alpha:g}, D = {noise.ks_stat:.4f}, {noise.num_values} values"
        return Judgement(
            Verdict.REJECTED, (Reason(ReasonCode.KS_REJECTED, Member.KS, text, noise.ks_p, settings.alpha, "1"),)
        )
    return Judgement(Verdict.ACCEPTED)


def judge_noise(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement:
    """Rejected when the distance from N(0, 1) exceeds its 5 % point by what can be seen (method.md sections 7, 10a)."""
    noise, member = diagnostics.noise, Member.NOISE
    unknown = _no_standardised(member, diagnostics, settings)
    if unknown is not None:
        return undetermined(unknown)
    excess = noise.ks_stat - KS_CRITICAL / math.sqrt(2 * noise.num_standardised)
    limit = settings.max_noise_distance
    text = f"D - {KS_CRITICAL:g} / sqrt(N) = {excess:.3f} > {limit:g}, N = {2 * noise.num_standardised}"
    if excess > limit and diagnostics.half_pixel:
        return Judgement(Verdict.ACCEPTED, (Reason(ReasonCode.PIXEL_CONVENTION, member, text, excess, limit, "1"),))
    if excess > limit:
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.NOISE_DIFFERS, member, text, excess, limit, "1"),))
    return Judgement(Verdict.ACCEPTED)


def _no_standardised(member: Member, diagnostics: Diagnostics, settings: AuditConfig) -> Reason | None:
    """Return why nothing can be said of the noise; None where something can."""
    noise, num_inliers = diagnostics.noise, diagnostics.num_inliers
    what = "inliers" if noise.num_standardised == num_inliers else f"standardised of {num_inliers} inliers"
    unknown = exact_projections(member, diagnostics) or too_few(member, what, noise.num_standardised, settings)
    if unknown is not None or noise.is_fitted:
        return unknown
    num = noise.num_standardised
    return Reason(ReasonCode.NOISE_NOT_FITTED, member, f"{num} observations", num, None, "count")


def judge_misfit(diagnostics: Diagnostics, found: MisfitDecision | None, settings: AuditConfig) -> Judgement:
    """Rejected where a group is material, undetermined where no lens group could be tested.

    Groups that the camera model already has are null and say nothing; that one of the others could not be tested is a
    remark.
    """
    misfit, member = diagnostics.misfit, Member.MISFIT
    if misfit is None or found is None:
        few = too_few(member, "inliers", diagnostics.num_inliers, settings)
        return undetermined(*([few] if few else []))
    num = diagnostics.num_inliers
    unknown = (
        exact_projections(member, diagnostics)
        or too_few(member, "inliers", num, settings)
        or too_few(member, f"of {num} inliers tested", misfit.num_tested, settings)
    )
    if unknown is not None:
        return undetermined(unknown)
    remarks = _not_tested(found)
    if found.group is not None and found.material:
        worth, shared = misfit.groups[found.group].worth, misfit.shared
        small = found.largest_px <= MAX_WORTHLESS_TAUS * found.tau_px and shared is None
        if small and worth is not None and is_worth_nothing(found.group, worth):
            return Judgement(Verdict.ACCEPTED, (_without_worth(found, worth), *remarks))
        beside = (
            ()
            if shared is None
            else (
                Reason(
                    ReasonCode.SHARED_CAMERA,
                    member,
                    shared.text,
                    shared.px,
                    found.tau_px,
                    "px",
                    shared.group,
                ),
            )
        )
        return Judgement(Verdict.REJECTED, (*beside, _misfit_reason(found, found.group), *remarks))
    if not misfit.num_lens_groups:
        nothing = Reason(ReasonCode.MISFIT_NOT_TESTED, member, "no group left")
        return undetermined(*(remarks or (nothing,)))
    return Judgement(Verdict.ACCEPTED, remarks)


def _without_worth(found: MisfitDecision, worth: Worth) -> Reason:
    turn, focal = (
        f"{worth.rotation_deg:.2g} degrees",
        "" if math.isnan(worth.focal_rel) else f", {worth.focal_rel:+.2g} of f",
    )
    text = f"{found.group} {found.px:.2f} px, worth {turn}, {worth.centre_rel:.2g} of the depth{focal}"
    return Reason(ReasonCode.MISFIT_WITHOUT_WORTH, Member.MISFIT, text, found.px, found.tau_px, "px", found.group)


def _not_tested(found: MisfitDecision) -> tuple[Reason, ...]:
    statuses = {status for _, status in found.untested}
    if len(found.untested) == len(MISFIT_CODES) and len(statuses) == 1:
        text = f"all groups ({statuses.pop()})"
        return (Reason(ReasonCode.MISFIT_NOT_TESTED, Member.MISFIT, text),)
    untested = [f"{group} ({status})" for group, status in found.untested]
    return (Reason(ReasonCode.MISFIT_NOT_TESTED, Member.MISFIT, ", ".join(untested)),) if untested else ()


def _misfit_reason(found: MisfitDecision, cause: MisfitGroup) -> Reason:
    others = [f"{group} {px:.2f} px" for group, px in found.also]
    text = f"{found.px:.2f} px, q = {found.q:.2g}" + (f" (also {', '.join(others)})" if others else "")
    return Reason(MISFIT_CODES[cause], Member.MISFIT, text, found.px, found.tau_px, "px", cause)


def judge_pose(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement:
    """Rejected when pose_offset_px exceeds its threshold; undetermined with too few inliers.

    Blind to a wrong pose that was adjusted together with its residuals: it is at its optimum.
    """
    member, offset, num = Member.POSE, diagnostics.pose_offset_px, diagnostics.num_inliers
    few = too_few(member, "inliers", num, settings)
    if few is not None:
        return undetermined(few)
    if math.isnan(offset):
        text = f"pose offset unknown, {num} inliers"
        return undetermined(Reason(ReasonCode.NON_FINITE_DERIVATIVES, member, text, num, None, "count"))
    limit = settings.pose_offset_threshold_px
    if diagnostics.half_pixel and limit < offset <= limit + HALF_PIXEL_SHIFT_PX:
        text = f"pose_offset_px = {offset:.3g}, of which half a pixel in x and y explains {HALF_PIXEL_SHIFT_PX:.2g}"
        return Judgement(Verdict.ACCEPTED, (Reason(ReasonCode.PIXEL_CONVENTION, member, text, offset, limit, "px"),))
    if offset > limit:
        text = f"pose_offset_px = {offset:.3g} > {limit:g}"
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.POSE_NOT_OPTIMAL, member, text, offset, limit, "px"),))
    return Judgement(Verdict.ACCEPTED)


def judge_plausible(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement:
    """Judge whether this could be a camera, and whether the image says enough about it.

    All reasons are listed, also the undetermined ones of a rejected image. That k1 is not identified is a reason only:
    an accepted image may carry it (the advice is a camera model without it).
    """
    camera = diagnostics.camera
    few = too_few(Member.PLAUSIBLE, "inliers", diagnostics.num_inliers, settings)
    if camera is None:
        return undetermined(*([few] if few else []))
    rejections = _implausible(camera, settings)
    doubts = [few] if few is not None else _too_little(camera, diagnostics.num_inliers, settings)
    remarks = [] if few is not None else _k1_remark(camera, settings)
    verdict = Verdict.REJECTED if rejections else Verdict.UNDETERMINED if doubts else Verdict.ACCEPTED
    return Judgement(verdict, (*rejections, *doubts, *remarks, *diagnostics.remarks))


def _implausible(camera: CameraDiagnostics, settings: AuditConfig) -> list[Reason]:
    """Reasons to reject the camera as such."""
    reasons = []
    low, high, focal = settings.min_focal_over_size, settings.max_focal_over_size, camera.focal_over_size
    if camera.principal_point_px is not None and not low <= focal <= high:
        text = f"f / max(w, h) = {focal:.3g}, outside [{low:g}, {high:g}]"
        limit = high if focal > high else low
        reasons.append(Reason(ReasonCode.FOCAL_OUT_OF_RANGE, Member.PLAUSIBLE, text, focal, limit, "1"))
    width, height = camera.size_px
    if camera.folds_over:
        text = f"inside the image of {width} x {height} px"
        reasons.append(Reason(ReasonCode.DISTORTION_FOLDS, Member.PLAUSIBLE, text))
    if camera.principal_point_px is not None and camera.principal_point_outside:
        x, y = camera.principal_point_px
        text = f"({x:.1f}, {y:.1f}) px, image of {width} x {height} px"
        reasons.append(Reason(ReasonCode.PRINCIPAL_POINT_OUTSIDE, Member.PLAUSIBLE, text))
    return reasons


def _too_little(camera: CameraDiagnostics, num_inliers: int, settings: AuditConfig) -> list[Reason]:
    """Reasons not to decide."""
    reasons = []
    if camera.has_focal and not camera.sd_focal_rel <= settings.max_sd_focal_rel:
        reasons.append(_focal_doubt(camera, num_inliers, settings))
    if not camera.coverage >= settings.min_coverage:
        text = f"{camera.coverage:.1%} < {settings.min_coverage:.0%} of the image"
        reasons.append(
            Reason(ReasonCode.LOW_COVERAGE, Member.PLAUSIBLE, text, camera.coverage, settings.min_coverage, "1")
        )
    cells, needed = camera.occupied_cells, settings.min_occupied_cells
    if cells < needed:
        text = f"{cells} < {needed}"
        reasons.append(Reason(ReasonCode.FEW_OCCUPIED_CELLS, Member.PLAUSIBLE, text, cells, needed, "count"))
    return reasons


def _focal_doubt(camera: CameraDiagnostics, num_inliers: int, settings: AuditConfig) -> Reason:
    """Why nothing is known of the focal length: derivatives, noise, a singular N, or a large deviation."""
    member, share, sd = Member.PLAUSIBLE, camera.singular_share, camera.sd_focal_rel
    if math.isnan(share):
        text = f"covariance unknown, {num_inliers} inliers"
        return Reason(ReasonCode.NON_FINITE_DERIVATIVES, member, text, num_inliers, None, "count")
    if camera.is_singular:
        text = f"smallest / largest singular value = {share:.2g}"
        return Reason(ReasonCode.FOCAL_NOT_IDENTIFIED, member, text, share, None, "1")
    if math.isnan(sd):
        text = f"{num_inliers} observations"
        return Reason(ReasonCode.NOISE_NOT_FITTED, member, text, num_inliers, None, "count")
    limit = settings.max_sd_focal_rel
    text = f"sd_f / f = {sd:.2%} > {limit:.2%}{_basis(camera)}"
    return Reason(ReasonCode.FOCAL_NOT_IDENTIFIED, member, text, sd, limit, "1")


def _basis(camera: CameraDiagnostics) -> str:
    return "" if camera.is_joint else ", conditional on the points"


def _k1_remark(camera: CameraDiagnostics, settings: AuditConfig) -> list[Reason]:
    """That k1 is not identified, which decides nothing; an unknown deviation identifies nothing."""
    if camera.k1 is None or abs(camera.k1) >= settings.min_k1_sds * camera.sd_k1:
        return []
    text = f"{camera.k1:.3g}, sd = {camera.sd_k1:.2g}{_basis(camera)}"
    return [Reason(ReasonCode.K1_NOT_IDENTIFIED, Member.PLAUSIBLE, text, camera.k1, camera.sd_k1, "1")]
