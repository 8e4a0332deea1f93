"""Each question by itself: from what is measured and settings to accepted, rejected or undetermined, with reasons.

method.md section 7. Of many images at once; every line here that decides is a row of tests/unit/test_decision_table.py.
"""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.judged import About, Judged, Said, said_of, say
from sfm_audit.audit.decision.measured import Measured, MeasuredCamera
from sfm_audit.audit.table.thresholds import EXACT_SHARE, HALF_PIXEL_SHIFT_PX, KS_CRITICAL
from sfm_audit.audit.table.words import Member, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_Unknown = tuple[BoolArray, list[Said]]


def taus_px(settings: AuditConfig, sigma_px: FloatArray) -> FloatArray:
    """Return min_effect in px for each of n images with noise ``sigma_px`` (n,)."""
    return np.array([settings.tau_px(sigma) for sigma in sigma_px.tolist()], dtype=np.float64)


def too_few(member: Member, what: str, num: IntArray, asked: BoolArray, settings: AuditConfig) -> _Unknown:
    """Return where ``num`` (n,) observations are too few, of those that are asked (n,), and the reason."""
    needed = settings.min_observations
    few = asked & (num < needed)
    about = About(ReasonCode.TOO_FEW_OBSERVATIONS, member, "count")
    return few, [say(few, about, lambda i: f"{num[i]} {what}, {needed} needed", num, needed, depends_on=[num])]


def exact_projections(member: Member, measured: Measured, asked: BoolArray) -> _Unknown:
    """Return where 2D points are no measurements, of those that are asked (n,), and the reason."""
    largest, limit = measured.largest_residual_px, EXACT_SHARE * measured.longer_side_px
    exact = asked & (measured.num_inliers > 0) & (largest <= limit)
    about = About(ReasonCode.EXACT_PROJECTIONS, member, "px")
    return exact, [say(exact, about, lambda i: f"largest residual {largest[i]:.2g} px", largest, limit)]


def exact_or_few(member: Member, measured: Measured, asked: BoolArray, settings: AuditConfig) -> _Unknown:
    """Return where nothing can be said because 2D points are no measurements, or else because inliers are too few."""
    exact, said = exact_projections(member, measured, asked)
    few, of_few = too_few(member, "inliers", measured.num_inliers, asked & ~exact, settings)
    return exact | few, [*said, *of_few]


def judge_ks(measured: Measured, settings: AuditConfig) -> Judged:
    """The paper's decision: rejected when ks_p < alpha; and, where asked for, D is larger than ``min_ks_distance``."""
    noise, alpha = measured.noise, settings.alpha
    unknown, said = _no_standardised(Member.KS, measured, settings)
    rejected = ~unknown & (noise.ks_p < alpha) & (noise.ks_stat > settings.min_ks_distance)

    def text(i: int) -> str:
        return f"p = {noise.ks_p[i]:.3g} < {alpha:g}, D = {noise.ks_stat[i]:.4f}, {noise.num_values[i]} values"

    said.append(say(rejected, About(ReasonCode.KS_REJECTED, Member.KS, "1"), text, noise.ks_p, alpha))
    return Judged.of({Verdict.REJECTED: rejected, Verdict.UNDETERMINED: unknown}, Verdict.ACCEPTED, said)


def judge_noise(measured: Measured, settings: AuditConfig) -> Judged:
    """Rejected when the distance from N(0, 1) exceeds its 5 % point by what can be seen (method.md sections 7, 10a)."""
    noise, member, limit = measured.noise, Member.NOISE, settings.max_noise_distance
    unknown, said = _no_standardised(member, measured, settings)
    num_values = 2 * noise.num_standardised
    with np.errstate(divide="ignore"):
        excess = noise.ks_stat - KS_CRITICAL / np.sqrt(num_values)
    differs = ~unknown & (excess > limit)
    rejected = differs & ~measured.half_pixel

    def text(i: int) -> str:
        return f"D - {KS_CRITICAL:g} / sqrt(N) = {excess[i]:.3f} > {limit:g}, N = {num_values[i]}"

    convention = About(ReasonCode.PIXEL_CONVENTION, member, "1")
    said.append(say(differs & measured.half_pixel, convention, text, excess, limit))
    said.append(say(rejected, About(ReasonCode.NOISE_DIFFERS, member, "1"), text, excess, limit))
    return Judged.of({Verdict.REJECTED: rejected, Verdict.UNDETERMINED: unknown}, Verdict.ACCEPTED, said)


def _no_standardised(member: Member, measured: Measured, settings: AuditConfig) -> _Unknown:
    """Return where nothing can be said of the noise, and why."""
    noise, num_inliers = measured.noise, measured.num_inliers
    num, needed = noise.num_standardised, settings.min_observations
    exact, said = exact_projections(member, measured, np.ones(len(measured), dtype=bool))
    few = ~exact & (num < needed)
    unfitted = ~exact & ~few & ~noise.is_fitted

    def text(i: int) -> str:
        what = "inliers" if num[i] == num_inliers[i] else f"standardised of {num_inliers[i]} inliers"
        return f"{num[i]} {what}, {needed} needed"

    about = About(ReasonCode.TOO_FEW_OBSERVATIONS, member, "count")
    said.append(say(few, about, text, num, needed, depends_on=[num, num_inliers]))
    about = About(ReasonCode.NOISE_NOT_FITTED, member, "count")
    said.append(say(unfitted, about, lambda i: f"{num[i]} observations", num))
    return exact | few | unfitted, said


def judge_pose(measured: Measured, settings: AuditConfig) -> Judged:
    """Rejected when pose_offset_px exceeds its threshold; undetermined with too few inliers.

    Blind to a wrong pose that was adjusted together with its residuals: it is at its optimum.
    """
    member, offset, num = Member.POSE, measured.pose_offset_px, measured.num_inliers
    limit = settings.pose_offset_threshold_px
    few, said = too_few(member, "inliers", num, np.ones(len(num), dtype=bool), settings)
    unknown = ~few & np.isnan(offset)
    away = ~few & (offset > limit)
    explained = away & measured.half_pixel & (offset <= limit + HALF_PIXEL_SHIFT_PX)
    rejected = away & ~explained

    def of_half_pixel(i: int) -> str:
        return f"pose_offset_px = {offset[i]:.3g}, of which half a pixel in x and y explains {HALF_PIXEL_SHIFT_PX:.2g}"

    about = About(ReasonCode.NON_FINITE_DERIVATIVES, member, "count")
    said.append(say(unknown, about, lambda i: f"pose offset unknown, {num[i]} inliers", num))
    said.append(say(explained, About(ReasonCode.PIXEL_CONVENTION, member, "px"), of_half_pixel, offset, limit))
    about = About(ReasonCode.POSE_NOT_OPTIMAL, member, "px")
    said.append(say(rejected, about, lambda i: f"pose_offset_px = {offset[i]:.3g} > {limit:g}", offset, limit))
    return Judged.of({Verdict.REJECTED: rejected, Verdict.UNDETERMINED: few | unknown}, Verdict.ACCEPTED, said)


def judge_plausible(measured: Measured, settings: AuditConfig) -> Judged:
    """Judge whether this could be a camera, and whether the image says enough about it.

    All reasons are listed, also the undetermined ones of a rejected image. That k1 is not identified is a reason only:
    an accepted image may carry it (the advice is a camera model without it).
    """
    camera = measured.camera
    everybody = np.ones(len(measured), dtype=bool)
    few, of_few = too_few(Member.PLAUSIBLE, "inliers", measured.num_inliers, everybody, settings)
    rejected, rejections = _implausible(camera, settings)
    doubtful, doubts = _too_little(measured, ~few, settings)
    remarks = [_k1_remark(camera, ~few, settings), *said_of(measured.remarks, Member.PLAUSIBLE)]
    open_ = few | doubtful | ~camera.known
    cases = {Verdict.REJECTED: rejected, Verdict.UNDETERMINED: open_}
    return Judged.of(cases, Verdict.ACCEPTED, [*rejections, *of_few, *doubts, *remarks])


def _implausible(camera: MeasuredCamera, settings: AuditConfig) -> _Unknown:
    """Reasons to reject the camera as such, and where there is one."""
    low, high, focal = settings.min_focal_over_size, settings.max_focal_over_size, camera.focal_over_size
    at, size = camera.principal_point_px, camera.size_px
    known, has_centre = camera.known, camera.has_principal_point
    odd = known & has_centre & ~((low <= focal) & (focal <= high))
    folds = known & camera.folds_over
    outside = known & has_centre & ~((at >= 0.0) & (at <= size)).all(axis=1)

    def sized(i: int) -> str:
        return f"{size[i, 0]} x {size[i, 1]} px"

    about = About(ReasonCode.FOCAL_OUT_OF_RANGE, Member.PLAUSIBLE, "1")
    words = f"outside [{low:g}, {high:g}]"
    limit = np.where(focal > high, high, low)
    return odd | folds | outside, [
        say(odd, about, lambda i: f"f / max(w, h) = {focal[i]:.3g}, {words}", focal, limit),
        say(folds, About(ReasonCode.DISTORTION_FOLDS, Member.PLAUSIBLE), lambda i: f"inside the image of {sized(i)}"),
        say(
            outside,
            About(ReasonCode.PRINCIPAL_POINT_OUTSIDE, Member.PLAUSIBLE),
            lambda i: f"({at[i, 0]:.1f}, {at[i, 1]:.1f}) px, image of {sized(i)}",
        ),
    ]


def _too_little(measured: Measured, enough: BoolArray, settings: AuditConfig) -> _Unknown:
    """Reasons not to decide, and where there is one; of images with enough inliers (n,)."""
    camera, member = measured.camera, Member.PLAUSIBLE
    asked = enough & camera.known
    share, least = camera.coverage, settings.min_coverage
    cells, needed = camera.occupied_cells, settings.min_occupied_cells
    unsure = asked & camera.has_focal & ~(camera.sd_focal_rel <= settings.max_sd_focal_rel)
    low, few_cells = asked & ~(share >= least), asked & (cells < needed)
    return unsure | low | few_cells, [
        *_focal_doubts(measured, unsure, settings),
        say(
            low,
            About(ReasonCode.LOW_COVERAGE, member, "1"),
            lambda i: f"{share[i]:.1%} < {least:.0%} of the image",
            share,
            least,
        ),
        say(
            few_cells,
            About(ReasonCode.FEW_OCCUPIED_CELLS, member, "count"),
            lambda i: f"{cells[i]} < {needed}",
            cells,
            needed,
        ),
    ]


def _focal_doubts(measured: Measured, unsure: BoolArray, settings: AuditConfig) -> list[Said]:
    """Why nothing is known of the focal length: derivatives, noise, a singular N, or a large deviation."""
    camera, num, member, limit = measured.camera, measured.num_inliers, Member.PLAUSIBLE, settings.max_sd_focal_rel
    share, sd = camera.singular_share, camera.sd_focal_rel
    underived = unsure & np.isnan(share)
    singular = unsure & ~underived & camera.is_singular
    unfitted = unsure & ~underived & ~singular & np.isnan(sd)
    large = unsure & ~underived & ~singular & ~unfitted
    not_identified = About(ReasonCode.FOCAL_NOT_IDENTIFIED, member, "1")
    return [
        say(
            underived,
            About(ReasonCode.NON_FINITE_DERIVATIVES, member, "count"),
            lambda i: f"covariance unknown, {num[i]} inliers",
            num,
        ),
        say(singular, not_identified, lambda i: f"smallest / largest singular value = {share[i]:.2g}", share),
        say(unfitted, About(ReasonCode.NOISE_NOT_FITTED, member, "count"), lambda i: f"{num[i]} observations", num),
        say(
            large,
            not_identified,
            lambda i: f"sd_f / f = {sd[i]:.2%} > {limit:.2%}{_basis(camera, i)}",
            sd,
            limit,
        ),
    ]


def _basis(camera: MeasuredCamera, i: int) -> str:
    return "" if camera.is_joint[i] else ", conditional on the points"


def _k1_remark(camera: MeasuredCamera, enough: BoolArray, settings: AuditConfig) -> Said:
    """That k1 is not identified, which decides nothing; an unknown deviation identifies nothing."""
    k1, sd = camera.k1, camera.sd_k1
    vague: FloatArray = settings.min_k1_sds * sd
    holds = enough & camera.known & camera.has_k1 & ~(np.abs(k1) >= vague)
    about = About(ReasonCode.K1_NOT_IDENTIFIED, Member.PLAUSIBLE, "1")
    return say(holds, about, lambda i: f"{k1[i]:.3g}, sd = {sd[i]:.2g}{_basis(camera, i)}", k1, sd)
