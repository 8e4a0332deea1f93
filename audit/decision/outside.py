"""What do witnesses outside of the image say? (method.md section 13)."""

from __future__ import annotations

import math
from typing import Final

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import Diagnostics
from sfm_audit.audit.decision.members import Judgement
from sfm_audit.audit.table.witnesses import WitnessStatement
from sfm_audit.audit.table.words import REASONS, WITNESS_CODES, Member, Reason, Verdict, strongest

_MEMBER: Final = Member.OUTSIDE


def judge_outside(diagnostics: Diagnostics, settings: AuditConfig) -> Judgement | None:
    """Rejected where a witness that may reject disagrees, undetermined where another one does; else accepted.

    None where no witness was asked, or none has anything to say of this image. Which witnesses may reject follows from
    their false alarms on healthy images of real photos (`audit.table.witnesses`).
    """
    if not diagnostics.testimonies:
        return None
    reasons = tuple(_reason(each) for each in diagnostics.testimonies if disagrees(each, settings))
    verdicts = (REASONS[reason.code].makes for reason in reasons)
    return Judgement(strongest(verdicts) if reasons else Verdict.ACCEPTED, reasons)


def disagrees(testimony: WitnessStatement, settings: AuditConfig) -> bool:
    """Whether a witness speaks against the image: above its limit, and significant where it has a q-value."""
    return testimony.score > testimony.limit and (math.isnan(testimony.q) or testimony.q < settings.alpha)


def _reason(testimony: WitnessStatement) -> Reason:
    code = WITNESS_CODES[testimony.witness]
    return Reason(code, _MEMBER, testimony.text, testimony.score, testimony.limit, testimony.unit)
