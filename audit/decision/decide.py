"""The only place that decides: from the diagnostics of one image and the settings to all verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.camera import judge_camera, pose_alone
from sfm_audit.audit.decision.diagnostics import Diagnostics
from sfm_audit.audit.decision.members import (
    Judgement,
    judge_ks,
    judge_misfit,
    judge_noise,
    judge_plausible,
    judge_pose,
)
from sfm_audit.audit.decision.misfit import MisfitDecision, decide_misfit
from sfm_audit.audit.decision.outside import judge_outside
from sfm_audit.audit.decision.severity import severity_of
from sfm_audit.audit.table.words import POLICIES, Member, PolicyName, Reason, ReasonCode, Severity, Verdict, strongest


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What is said of one image.

    members: each question's judgement; a question that was not asked is missing.
    judgement: of the policy, with the reasons of its members.    misfit: None where nothing was tested.
    severity: of the members' rejections; None where no member rejects.    pose_first: the pose explains what freeing
    pose and camera would gain, so its reasons come before the camera's.
    """

    members: Mapping[Member, Judgement]
    judgement: Judgement
    misfit: MisfitDecision | None
    severity: Severity | None = None
    pose_first: bool = False

    @property
    def verdict(self) -> Verdict:
        """The verdict of the policy."""
        return self.judgement.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The reasons of the policy's members."""
        return self.judgement.reasons

    @property
    def all_reasons(self) -> tuple[Reason, ...]:
        """The reasons of all members that were asked, in the order of `Member`."""
        return tuple(reason for judgement in self.members.values() for reason in judgement.reasons)

    def of(self, member: Member) -> Verdict | None:
        """The verdict of one member, None where it was not asked."""
        judgement = self.members.get(member)
        return None if judgement is None else judgement.verdict

    def under(self, policy: PolicyName) -> Judgement:
        """Return the verdict of a policy with the reasons of its members."""
        return judgement_under(self.members, policy, pose_first=self.pose_first)


def decide(diagnostics: Diagnostics, settings: AuditConfig) -> Decision:
    """Decide about one image or one estimated camera.

    Parameters
    ----------
    diagnostics : the numbers            settings : thresholds and the policy

    Returns
    -------
    Decision
        Every member that the numbers allow to ask is undetermined where something stands in its way.

    Notes
    -----
    method.md section 7. Run, calibrate, explain, demo, and all that decide a finished run again call this.
    """
    found = _misfit(diagnostics, settings)
    blocked = diagnostics.unusable or _all_behind(diagnostics)
    if blocked is not None:
        asked = [member for member in Member if member is not Member.OUTSIDE]
        members: dict[Member, Judgement] = {
            m: Judgement(Verdict.UNDETERMINED, (replace(blocked, member=m),)) for m in asked
        }
    else:
        camera, outside = judge_camera(diagnostics, settings), judge_outside(diagnostics, settings)
        members = {
            Member.MISFIT: judge_misfit(diagnostics, found, settings),
            **({} if camera is None else {Member.CAMERA: camera}),
            Member.POSE: judge_pose(diagnostics, settings),
            Member.PLAUSIBLE: _without_k1_remark(judge_plausible(diagnostics, settings), camera),
            Member.NOISE: judge_noise(diagnostics, settings),
            Member.KS: judge_ks(diagnostics, settings),
            **({} if outside is None else {Member.OUTSIDE: outside}),
        }
    pose_first = pose_alone(diagnostics.gains)
    judgement = judgement_under(members, settings.policy, pose_first=pose_first)
    severity = severity_of(members, found, diagnostics.misfit)
    return Decision(members, judgement, found, severity, pose_first)


def judgement_under(members: Mapping[Member, Judgement], policy: PolicyName, *, pose_first: bool) -> Judgement:
    """Return rejected if any member rejects, else undetermined if any is, else accepted; each reason once."""
    order = list(POLICIES[policy])
    if pose_first and Member.POSE in order:
        order.remove(Member.POSE)
        order.insert(0, Member.POSE)
    deciding = [members[member] for member in order if member in members]
    reasons: dict[str, Reason] = {}
    for reason in (reason for each in deciding for reason in each.reasons):
        reasons.setdefault(str(reason), reason)
    return Judgement(strongest(each.verdict for each in deciding), tuple(reasons.values()))


def _without_k1_remark(plausible: Judgement, camera: Judgement | None) -> Judgement:
    """Leave out that k1 is small where the camera is rejected: a k1 frozen at 0 is wrong, not superfluous."""
    if camera is None or camera.verdict is not Verdict.REJECTED:
        return plausible
    kept = tuple(reason for reason in plausible.reasons if reason.code is not ReasonCode.K1_NOT_IDENTIFIED)
    return replace(plausible, reasons=kept)


def _all_behind(diagnostics: Diagnostics) -> Reason | None:
    """Nothing can be projected, or hardly anything: the reason that stands in the way of every question."""
    consistency = diagnostics.consistency
    if consistency is None or not consistency.all_behind:
        return None
    return Reason(ReasonCode.POINTS_BEHIND, Member.CAMERA, consistency.text)


def _misfit(diagnostics: Diagnostics, settings: AuditConfig) -> MisfitDecision | None:
    misfit = diagnostics.misfit
    if misfit is None:
        return None
    return decide_misfit(misfit.groups, alpha=settings.alpha, tau_px=settings.tau_px(misfit.sigma_px))
