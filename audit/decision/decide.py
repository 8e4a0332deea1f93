"""The only place that decides: from the diagnostics of one image and the settings to all verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import Diagnostics
from sfm_audit.audit.decision.members import Judgement, judge_ks, judge_misfit, judge_plausible, judge_pose
from sfm_audit.audit.decision.misfit import MisfitDecision, decide_misfit
from sfm_audit.audit.table.words import POLICIES, Member, PolicyName, Reason, Verdict, strongest


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What is said of one image.

    members: each question's judgement; a question that was not asked is missing.
    judgement: of the policy, with the reasons of its members.    misfit: None where nothing was tested.
    """

    members: Mapping[Member, Judgement]
    judgement: Judgement
    misfit: MisfitDecision | None

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
        return judgement_under(self.members, policy)


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
    unusable = diagnostics.unusable
    if unusable is not None:
        asked = (Member.MISFIT, Member.POSE, Member.PLAUSIBLE, Member.KS)
        members = {m: Judgement(Verdict.UNDETERMINED, (replace(unusable, member=m),)) for m in asked}
    else:
        members = {
            Member.MISFIT: judge_misfit(diagnostics, found, settings),
            Member.POSE: judge_pose(diagnostics, settings),
            Member.PLAUSIBLE: judge_plausible(diagnostics, settings),
            Member.KS: judge_ks(diagnostics, settings),
        }
    return Decision(members, judgement_under(members, settings.policy), found)


def judgement_under(members: Mapping[Member, Judgement], policy: PolicyName) -> Judgement:
    """Return rejected if any member rejects, else undetermined if any is, else accepted; each reason once."""
    deciding = [members[member] for member in POLICIES[policy] if member in members]
    reasons: dict[str, Reason] = {}
    for reason in (reason for each in deciding for reason in each.reasons):
        reasons.setdefault(str(reason), reason)
    return Judgement(strongest(each.verdict for each in deciding), tuple(reasons.values()))


def _misfit(diagnostics: Diagnostics, settings: AuditConfig) -> MisfitDecision | None:
    misfit = diagnostics.misfit
    if misfit is None:
        return None
    return decide_misfit(misfit.groups, alpha=settings.alpha, tau_px=settings.tau_px(misfit.sigma_px))
