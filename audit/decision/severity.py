"""How bad is it that an image is rejected? (method.md section 11)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from sfm_audit.audit.decision.judged import Judged
from sfm_audit.audit.table.thresholds import (
    HARD_WORTH_DEG,
    HARD_WORTH_FOCAL_REL,
    WEAK_WORTH_DEG,
    WEAK_WORTH_FOCAL_REL,
)
from sfm_audit.audit.table.words import SEVERITY_ORDER, VERDICT_ORDER, Member, Severity, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

SEVERITIES: Final = tuple(sorted(Severity, key=SEVERITY_ORDER.__getitem__))
"""A severity in a column is its place in here; -1: no member rejects."""
_ALWAYS_HARD = (Member.CAMERA, Member.POSE, Member.PLAUSIBLE, Member.OUTSIDE)


def severities_of(members: Mapping[Member, Judged], worth: FloatArray) -> IntArray:
    """Return how severe the members' rejections are, (n,) places in SEVERITIES, -1 where no member rejects.

    Hard: parts that do not fit, a pose, an implausible camera, a camera away from its optimum, a witness outside, or a
    misfit worth more than 0.2 degrees or 1 % of f. Weak: the noise alone, or a misfit worth next to nothing.

    Parameters
    ----------
    worth : (n, 3) of the named misfit, NaN where it is not known
    """
    rejecting = {member: judged.verdict == VERDICT_ORDER[Verdict.REJECTED] for member, judged in members.items()}
    hard = _any([rejecting[member] for member in _ALWAYS_HARD])
    severity = np.where(rejecting[Member.MISFIT], worth_severities(worth), SEVERITY_ORDER[Severity.WEAK])
    severity[hard] = SEVERITY_ORDER[Severity.HARD]
    return np.where(_any(list(rejecting.values())), severity, -1)


def _any(masks: list[BoolArray]) -> BoolArray:
    return np.asarray(np.logical_or.reduce(masks))


def worth_severities(worth: FloatArray) -> IntArray:
    """Return the severity of misfits by their worth (n, 3), places in SEVERITIES; medium where that is not known."""
    deg, _, focal = worth.T
    focal = np.where(np.isnan(focal), 0.0, np.abs(focal))
    weak = (deg < WEAK_WORTH_DEG) & (focal < WEAK_WORTH_FOCAL_REL)
    hard = ~np.isnan(deg) & ((deg > HARD_WORTH_DEG) | (focal > HARD_WORTH_FOCAL_REL))
    severity = np.where(weak, SEVERITY_ORDER[Severity.WEAK], SEVERITY_ORDER[Severity.MEDIUM])
    severity[hard] = SEVERITY_ORDER[Severity.HARD]
    return severity
