"""Which misfit is there, which is material, and which is the cause? (method.md sections 5 and 7)."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from sfm_audit.audit.decision.diagnostics import GroupDiagnostics, Worth
from sfm_audit.audit.table.thresholds import (
    MIN_SHIFT_WORTH_CENTRE,
    MIN_SHIFT_WORTH_FOCAL_REL,
    WEAK_WORTH_DEG,
    WEAK_WORTH_FOCAL_REL,
)
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

_SHIFTS = frozenset({MisfitGroup.PRINCIPAL_POINT, MisfitGroup.TANGENTIAL})
_SAYS_NOTHING = frozenset({MisfitStatus.TESTED, MisfitStatus.ABSORBED})


@dataclass(frozen=True, slots=True)
class MisfitDecision:
    """What is wrong with a camera: the named cause, and what is material.

    group: the cause, None where no group is significant.    px, q: the cause's effect and q, else NaN.
    material: significant groups with an effect above tau_px.    also: the other material ones with their effects.
    untested: groups that could not be tested, and why.
    """

    group: MisfitGroup | None
    px: float
    q: float
    tau_px: float
    material: tuple[MisfitGroup, ...]
    also: tuple[tuple[MisfitGroup, float], ...]
    untested: tuple[tuple[MisfitGroup, MisfitStatus], ...]

    @property
    def largest_px(self) -> float:
        """The largest effect among the material groups, NaN without a cause."""
        return max((self.px, *(px for _, px in self.also)))


def decide_misfit(groups: Mapping[MisfitGroup, GroupDiagnostics], *, alpha: float, tau_px: float) -> MisfitDecision:
    """Name the cause among the material groups, among the significant ones where none is material."""
    significant = [group for group in GROUPS if groups[group].q < alpha]
    material = tuple(group for group in significant if groups[group].px > tau_px)
    cause = named_cause(groups, material or significant)
    untested = tuple((group, groups[group].status) for group in GROUPS if groups[group].status not in _SAYS_NOTHING)
    if cause is None:
        return MisfitDecision(None, math.nan, math.nan, tau_px, (), (), untested)
    also = tuple((group, groups[group].px) for group in material if group != cause)
    return MisfitDecision(cause, groups[cause].px, groups[cause].q, tau_px, material, also, untested)


def is_worth_nothing(group: MisfitGroup, worth: Worth | None) -> bool:
    """Whether admitting a misfit would change nothing that anybody uses: such an image is accepted with a remark.

    Unknown worth counts as enough.
    """
    if worth is None or math.isnan(worth.rotation_deg):
        return False
    focal = 0.0 if math.isnan(worth.focal_rel) else abs(worth.focal_rel)
    if group in _SHIFTS:
        return worth.centre_rel < MIN_SHIFT_WORTH_CENTRE and focal < MIN_SHIFT_WORTH_FOCAL_REL
    return worth.rotation_deg < WEAK_WORTH_DEG and focal < WEAK_WORTH_FOCAL_REL


def named_cause(
    groups: Mapping[MisfitGroup, GroupDiagnostics], candidates: Collection[MisfitGroup]
) -> MisfitGroup | None:
    """Return the candidate whose parameters pay most (BIC), None without candidates.

    A significant group is not yet the cause: a missing k2 also makes rolling_shutter significant. Tangential and
    principal_point span nearly the same fields; either is named, and they count as one answer.
    """
    tested = [group for group in GROUPS if group in candidates and groups[group].status is MisfitStatus.TESTED]
    return max(tested, key=lambda group: groups[group].gain, default=None)
