"""What is said of images: of one as a record, of many as columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.decision.judged import NOT_ASKED, VERDICTS, Judged, Judgement, Said
from sfm_audit.audit.decision.misfit import MisfitDecision, MisfitDecisions
from sfm_audit.audit.decision.severity import SEVERITIES
from sfm_audit.audit.table.words import (
    POLICIES,
    VERDICT_ORDER,
    Member,
    PolicyName,
    Reason,
    Severity,
    Verdict,
    strongest,
)
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

MEMBERS: Final = tuple(Member)


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
        """Return the verdict of a policy with the reasons of its members, each reason once."""
        deciding = [self.members[member] for member in deciders(policy, self.pose_first) if member in self.members]
        reasons: dict[str, Reason] = {}
        for reason in (reason for each in deciding for reason in each.reasons):
            reasons.setdefault(str(reason), reason)
        return Judgement(strongest(each.verdict for each in deciding), tuple(reasons.values()))


def deciders(policy: PolicyName, pose_first: bool) -> tuple[Member, ...]:
    """Return the members that decide under a policy, in the order in which their reasons are listed."""
    order = POLICIES[policy]
    if pose_first and Member.POSE in order:
        return Member.POSE, *(member for member in order if member is not Member.POSE)
    return order


@dataclass(frozen=True, slots=True, eq=False)
class Reasons:
    """All reasons of many images, by image in the order of `Decision.all_reasons`.

    said: the kinds of reasons.    row, kind, place: (m,) of each reason its image, its kind in ``said`` and which of
    them it is.
    """

    said: tuple[Said, ...]
    row: IntArray
    kind: IntArray
    place: IntArray

    @classmethod
    def of(cls, said: tuple[Said, ...]) -> Reasons:
        """Sort reasons by image."""
        counts = [each.rows.size for each in said]
        row = np.concatenate([np.empty(0, np.int64), *(each.rows for each in said)])
        kind = np.repeat(np.arange(len(said)), counts)
        place = np.concatenate([np.empty(0, np.int64), *(np.arange(count) for count in counts)])
        order = np.argsort(row, kind="stable")
        return cls(said, row[order], kind[order], place[order])

    @property
    def texts(self) -> list[str]:
        """What each says, m."""
        return [self.said[kind].texts[k] for kind, k in zip(self.kind.tolist(), self.place.tolist(), strict=True)]

    def numbers(self, name: str) -> FloatArray:
        """(m,) ``value`` or ``limit`` of each."""
        starts = np.cumsum([0, *(each.rows.size for each in self.said)])
        values = np.concatenate([np.empty(0), *(getattr(each, name) for each in self.said)])
        return np.asarray(values[starts[self.kind] + self.place])

    def only(self, kept: BoolArray | IntArray) -> Reasons:
        """Return some of them."""
        return Reasons(self.said, self.row[kept], self.kind[kept], self.place[kept])


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """What is said of n images.

    members: each question's verdicts and reasons.    misfit: what is decided of it.    severity: (n,) places in
    SEVERITIES, -1 where no member rejects.    pose_first: (n,), see `Decision`.    policy: of the run.
    """

    members: Mapping[Member, Judged]
    misfit: MisfitDecisions
    severity: IntArray
    pose_first: BoolArray
    policy: PolicyName

    def __len__(self) -> int:
        return len(self.severity)

    @property
    def verdict(self) -> IntArray:
        """(n,) the verdict of the policy, places in VERDICTS."""
        return self.under(self.policy)

    def under(self, policy: PolicyName) -> IntArray:
        """(n,) rejected if any member of the policy rejects, else undetermined if any is or none was asked."""
        said = np.minimum.reduce([self.members[member].verdict for member in POLICIES[policy]])
        return np.where(said == NOT_ASKED, VERDICT_ORDER[Verdict.UNDETERMINED], said)

    @property
    def rejects(self) -> BoolArray:
        """(n,) whether any member rejects, of the policy or not."""
        return self.severity >= 0

    @property
    def reasons(self) -> Reasons:
        """The reasons of all members."""
        return Reasons.of(tuple(each for member in MEMBERS for each in self.members[member].said))

    def decision(self, i: int) -> Decision:
        """Return what is said of the image in row i."""
        found = self.reasons
        own = found.only(found.row == i)
        reasons: dict[Member, list[Reason]] = {member: [] for member in MEMBERS}
        for kind, place in zip(own.kind.tolist(), own.place.tolist(), strict=True):
            reason = found.said[kind].reason(place)
            reasons[reason.member].append(reason)
        members = {
            member: Judgement(VERDICTS[judged.verdict[i]], tuple(reasons[member]))
            for member in MEMBERS
            if (judged := self.members[member]).verdict[i] != NOT_ASKED
        }
        severity = None if self.severity[i] < 0 else SEVERITIES[self.severity[i]]
        misfit, pose_first = self.misfit.record(i), bool(self.pose_first[i])
        judgement = Decision(members, Judgement(Verdict.UNDETERMINED), misfit, severity, pose_first).under(self.policy)
        return Decision(members, judgement, misfit, severity, pose_first)
