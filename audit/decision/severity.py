"""How bad is it that an image is rejected? (method.md section 11)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sfm_audit.audit.decision.diagnostics import MisfitDiagnostics, Worth
from sfm_audit.audit.decision.members import Judgement
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.table.thresholds import (
    HARD_WORTH_DEG,
    HARD_WORTH_FOCAL_REL,
    WEAK_WORTH_DEG,
    WEAK_WORTH_FOCAL_REL,
)
from sfm_audit.audit.table.words import Member, Severity, Verdict

_ALWAYS_HARD = (Member.CAMERA, Member.POSE, Member.PLAUSIBLE, Member.OUTSIDE)


def severity_of(
    members: Mapping[Member, Judgement], found: MisfitDecision | None, misfit: MisfitDiagnostics | None
) -> Severity | None:
    """Return how severe the members' rejections are; None where no member rejects.

    Hard: parts that do not fit, a pose, an implausible camera, a camera away from its optimum, a witness outside, or a
    misfit worth more than 0.2 degrees or 1 % of f. Weak: the noise alone, or a misfit worth next to nothing.
    """
    rejecting = {member for member, judgement in members.items() if judgement.verdict is Verdict.REJECTED}
    if not rejecting:
        return None
    if any(member in rejecting for member in _ALWAYS_HARD):
        return Severity.HARD
    if Member.MISFIT not in rejecting:
        return Severity.WEAK
    return worth_severity(worth_of(found, misfit))


def worth_of(found: MisfitDecision | None, misfit: MisfitDiagnostics | None) -> Worth | None:
    """Return what the named misfit is worth; None where it is not known."""
    if found is None or misfit is None or found.group is None:
        return None
    return misfit.groups[found.group].worth


def worth_severity(worth: Worth | None) -> Severity:
    """Return the severity of a misfit by its worth; medium where that is not known."""
    if worth is None or math.isnan(worth.rotation_deg):
        return Severity.MEDIUM
    focal = 0.0 if math.isnan(worth.focal_rel) else abs(worth.focal_rel)
    if worth.rotation_deg > HARD_WORTH_DEG or focal > HARD_WORTH_FOCAL_REL:
        return Severity.HARD
    if worth.rotation_deg < WEAK_WORTH_DEG and focal < WEAK_WORTH_FOCAL_REL:
        return Severity.WEAK
    return Severity.MEDIUM
