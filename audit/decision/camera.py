"""Do all parts fit, and do the camera's own parameters sit at their optimum? (method.md sections 11 and 12)."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import OwnDiagnostics, OwnStep
from sfm_audit.audit.decision.judged import About, Judged, say
from sfm_audit.audit.decision.measured import Measured, MeasuredOwn
from sfm_audit.audit.decision.members import exact_or_few, taus_px
from sfm_audit.audit.table.thresholds import MIN_OWN_STEP_SDS
from sfm_audit.audit.table.words import Member, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray

_MOST: Final = 0.9  # of what freeing both would gain: then one of them explains it alone


def judge_camera(measured: Measured, settings: AuditConfig) -> Judged:
    """Rejected where the parts do not belong together, or an own parameter is away from its optimum.

    Not asked where neither is known. Blind to what was adjusted together after the fault, and to parameters that nobody
    frees (principal point: finding implied_principal_point).
    """
    parts, own, num, member = measured.parts, measured.own, measured.num_inliers, Member.CAMERA
    apart = parts.known & parts.inconsistent
    unknown, said = exact_or_few(member, measured, parts.known & ~apart, settings)
    tau_px = taus_px(settings, own.sigma_px)
    asked = parts.known & ~apart & ~unknown & own.has_own
    untested = asked & ~(own.step_px >= 0)
    moved = asked & ~untested & material_steps(own, tau_px)

    def not_optimal(i: int) -> str:
        record = own.records[i]
        return "" if record is None or record.largest is None else step_text(record, record.largest)

    inconsistent = About(ReasonCode.INCONSISTENT, member, "px")
    not_tested = About(ReasonCode.CAMERA_NOT_TESTED, member, "count")
    said += [
        say(apart, inconsistent, lambda i: parts.texts.get(i, ""), parts.rms_px),
        say(untested, not_tested, lambda i: f"{num[i]} inliers", num, depends_on=[num]),
        say(moved, About(ReasonCode.CAMERA_NOT_OPTIMAL, member, "px"), not_optimal, own.step_px, tau_px),
    ]
    cases = {Verdict.REJECTED: apart | moved, Verdict.UNDETERMINED: unknown | untested}
    return Judged.of(cases, Verdict.ACCEPTED, said).of_those(parts.known)


def material_steps(own: MeasuredOwn, tau_px: FloatArray) -> BoolArray:
    """(n,) where the own step is material, and the parameter that moves most moves by more than its noise."""
    return np.asarray((own.step_px > tau_px) & (np.abs(own.largest) > MIN_OWN_STEP_SDS * own.largest_sd))


def material_step(own: OwnDiagnostics, tau_px: float) -> OwnStep | None:
    """Return the parameter that moves most where the own step is material; None where it is not."""
    return own.largest if material_steps(MeasuredOwn.of([own], [True]), np.array([tau_px]))[0] else None


def step_text(own: OwnDiagnostics, moved: OwnStep) -> str:
    """Name the parameter, a focal length as a change in percent too."""
    relative = ""
    if moved.name.startswith("f") and moved.stored:
        change, sd = moved.implied / moved.stored - 1.0, moved.sd / abs(moved.stored)
        relative = f" ({change:+.1%} +- {sd:.1%})"
    shared = f", {own.num_images} images" if own.num_images > 1 else ""
    return (
        f"{moved.name} = {moved.stored:.6g} stored, {moved.implied:.6g} +- {moved.sd:.2g} implied{relative}, "
        f"{own.step_px:.2f} px{shared}"
    )


def pose_alone(gains: FloatArray) -> BoolArray:
    """Whether the pose explains what freeing pose and camera would gain, and the camera does not; (n, 3) gains."""
    pose, camera, both = gains.T
    return np.asarray((both > 0) & (pose >= _MOST * both) & ~(camera >= _MOST * both))
