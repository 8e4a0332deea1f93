"""What do witnesses outside of the image say? (method.md section 13)."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.judged import Judged, said_of
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.table.witnesses import WitnessStatement
from sfm_audit.audit.table.words import REASONS, VERDICT_ORDER, WITNESS_CODES, Member, Reason, Verdict, strongest
from sfm_audit.loaders.arrays import IntArray

_MEMBER: Final = Member.OUTSIDE


def judge_outside(measured: Measured, settings: AuditConfig) -> Judged:
    """Rejected where a witness that may reject disagrees, undetermined where another one does; else accepted.

    Not asked where no witness was, or none has anything to say of this image. Which witnesses may reject follows from
    their false alarms on healthy images of real photos (`audit.table.witnesses`).
    """
    asked = np.array([bool(each) for each in measured.testimonies], dtype=bool)
    reasons: dict[int, list[Reason]] = {}
    verdict: IntArray = np.full(len(asked), VERDICT_ORDER[Verdict.ACCEPTED])
    for row in np.flatnonzero(asked).tolist():
        against = [_reason(each) for each in measured.testimonies[row] or () if disagrees(each, settings)]
        if against:
            reasons[row] = against
            verdict[row] = VERDICT_ORDER[strongest(REASONS[reason.code].makes for reason in against)]
    return Judged(verdict, tuple(said_of(reasons, _MEMBER))).of_those(asked)


def disagrees(testimony: WitnessStatement, settings: AuditConfig) -> bool:
    """Whether a witness speaks against the image: above its limit, and significant where it has a q-value."""
    return testimony.score > testimony.limit and (math.isnan(testimony.q) or testimony.q < settings.alpha)


def _reason(testimony: WitnessStatement) -> Reason:
    code = WITNESS_CODES[testimony.witness]
    return Reason(code, _MEMBER, testimony.text, testimony.score, testimony.limit, testimony.unit)
