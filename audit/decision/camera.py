"""Do all parts fit, and do the camera's own parameters sit at their optimum? (method.md sections 11 and 12)."""

from __future__ import annotations

from typing import Final

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import Diagnostics, Gains, OwnDiagnostics, OwnStep
from sfm_audit.audit.decision.members import Judgement, exact_projections, too_few, undetermined
from sfm_audit.audit.table.thresholds import MIN_OWN_STEP_SDS
from sfm_audit.audit.table.words import Member, Reason, ReasonCode, Verdict

_MOST: Final = 0.9  # of what freeing both would gain: then one of them explains it alone


def judge_camera(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement | None:
    """Rejected where the parts do not belong together, or an own parameter is away from its optimum.

    None where neither was asked. Blind to what was adjusted together after the fault, and to parameters that nobody
    frees (principal point: finding implied_principal_point).
    """
    consistency = diagnostics.consistency
    if consistency is None:
        return None
    member = Member.CAMERA
    if consistency.inconsistent:
        text, rms_px = consistency.text, consistency.rms_px
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.INCONSISTENT, member, text, rms_px, None, "px"),))
    unknown = exact_projections(member, diagnostics) or too_few(member, "inliers", diagnostics.num_inliers, settings)
    if unknown is not None:
        return undetermined(unknown)
    return _judge_own(diagnostics, settings) if diagnostics.has_own else Judgement(Verdict.ACCEPTED)


def _judge_own(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement:
    """Whether the camera's own parameters sit at their optimum."""
    own, member = diagnostics.own, Member.CAMERA
    if own is None or not own.step_px >= 0:
        num = diagnostics.num_inliers
        return undetermined(Reason(ReasonCode.CAMERA_NOT_TESTED, member, f"{num} inliers", num, None, "count"))
    tau_px = settings.tau_px(own.sigma_px)
    moved = material_step(own, tau_px)
    if moved is None:
        return Judgement(Verdict.ACCEPTED)
    return Judgement(Verdict.REJECTED, (_not_optimal(own, moved, tau_px),))


def material_step(own: OwnDiagnostics, tau_px: float) -> OwnStep | None:
    """Return the parameter that moves most where the own step is material; None where it is not."""
    largest = own.largest
    if largest is None or not own.step_px > tau_px or not abs(largest.step) > MIN_OWN_STEP_SDS * largest.sd:
        return None
    return largest


def _not_optimal(own: OwnDiagnostics, moved: OwnStep, tau_px: float) -> Reason:
    """Name the parameter, a focal length as a change in percent too."""
    relative = ""
    if moved.name.startswith("f") and moved.stored:
        change, sd = moved.implied / moved.stored - 1.0, moved.sd / abs(moved.stored)
        relative = f" ({change:+.1%} +- {sd:.1%})"
    shared = f", {own.num_images} images" if own.num_images > 1 else ""
    text = (
        f"{moved.name} = {moved.stored:.6g} stored, {moved.implied:.6g} +- {moved.sd:.2g} implied{relative}, "
        f"{own.step_px:.2f} px{shared}"
    )
    return Reason(ReasonCode.CAMERA_NOT_OPTIMAL, Member.CAMERA, text, own.step_px, tau_px, "px")


def pose_alone(gains: Gains | None) -> bool:
    """Whether the pose explains what freeing pose and camera would gain, and the camera does not."""
    if gains is None or not gains.both > 0:
        return False
    return gains.pose >= _MOST * gains.both and not gains.camera >= _MOST * gains.both
