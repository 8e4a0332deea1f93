"""The only place that decides: from what is measured of images and the settings to all verdicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.camera import judge_camera, pose_alone
from sfm_audit.audit.decision.decisions import MEMBERS, Decision, Decisions
from sfm_audit.audit.decision.diagnostics import Diagnostics
from sfm_audit.audit.decision.judged import Judged, said_of
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.decision.members import judge_ks, judge_noise, judge_plausible, judge_pose, taus_px
from sfm_audit.audit.decision.misfit import decide_misfits, judge_misfit
from sfm_audit.audit.decision.outside import judge_outside
from sfm_audit.audit.decision.severity import severities_of
from sfm_audit.audit.table.words import VERDICT_ORDER, Member, Reason, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray


def decide(diagnostics: Diagnostics, settings: AuditConfig) -> Decision:
    """Decide about one image or one estimated camera, as `decide_all` does about many."""
    return decide_all(Measured.of([diagnostics]), settings).decision(0)


def decide_all(measured: Measured, settings: AuditConfig) -> Decisions:
    """Decide about images.

    Parameters
    ----------
    measured : the numbers            settings : thresholds and the policy

    Returns
    -------
    Decisions
        Every member that the numbers allow to ask is undetermined where something stands in its way.

    Notes
    -----
    method.md section 7. Run, calibrate, explain, demo, and all that decide a finished run again call this.
    """
    tau_px = taus_px(settings, measured.misfit.sigma_px)
    found = decide_misfits(measured.misfit, alpha=settings.alpha, tau_px=tau_px)
    camera = judge_camera(measured, settings)
    judged = {
        Member.MISFIT: judge_misfit(measured, found, settings),
        Member.CAMERA: camera,
        Member.POSE: judge_pose(measured, settings),
        Member.PLAUSIBLE: _without_k1_remark(judge_plausible(measured, settings), camera),
        Member.NOISE: judge_noise(measured, settings),
        Member.KS: judge_ks(measured, settings),
        Member.OUTSIDE: judge_outside(measured, settings),
    }
    blocked = _blocked(measured)
    members = {member: _unless(blocked, member, judged[member]) for member in MEMBERS} if blocked else judged
    severity = severities_of(members, found.worth)
    return Decisions(members, found, severity, pose_alone(measured.gains), settings.policy)


def _blocked(measured: Measured) -> dict[int, Reason]:
    """By row the reason that stands in the way of every question: nothing can be projected, or hardly anything."""
    parts = measured.parts
    behind = {
        row: Reason(ReasonCode.POINTS_BEHIND, Member.CAMERA, parts.texts.get(row, ""))
        for row in np.flatnonzero(parts.all_behind).tolist()
    }
    return {**behind, **measured.unusable}


def _unless(blocked: dict[int, Reason], member: Member, judged: Judged) -> Judged:
    """Leave open what nobody can answer; witnesses outside are not asked then."""
    free: BoolArray = np.ones(len(judged.verdict), dtype=bool)
    free[list(blocked)] = False
    left = judged.of_those(free)
    if member is Member.OUTSIDE:
        return left
    reasons = {row: [replace(reason, member=member)] for row, reason in blocked.items()}
    verdict = np.where(free, left.verdict, VERDICT_ORDER[Verdict.UNDETERMINED])
    return Judged(verdict, (*left.said, *said_of(reasons, member)))


def _without_k1_remark(plausible: Judged, camera: Judged) -> Judged:
    """Leave out that k1 is small where the camera is rejected: a k1 frozen at 0 is wrong, not superfluous."""
    kept = camera.verdict != VERDICT_ORDER[Verdict.REJECTED]
    said = (each.only(kept) if each.code is ReasonCode.K1_NOT_IDENTIFIED else each for each in plausible.said)
    return replace(plausible, said=tuple(each for each in said if each.rows.size))
