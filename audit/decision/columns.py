"""What a decision writes into the images table, in a run and when a finished run is decided again."""

from __future__ import annotations

import math
from typing import Final

from sfm_audit.audit.decision.decide import Decision
from sfm_audit.audit.decision.diagnostics import MisfitDiagnostics
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.decision.severity import worth_of
from sfm_audit.audit.table.words import Member

CAUSE_COLUMNS: Final = ("misfit_group", "misfit_px", "misfit_q")
WORTH_COLUMNS: Final = ("misfit_px_sigma", "misfit_worth_deg", "misfit_worth_centre", "misfit_worth_focal_rel")
_MEMBERS: Final = tuple((member, str(member)) for member in Member)
VERDICT_COLUMNS: Final = ("verdict", *(name for _, name in _MEMBERS), "severity", "reasons", "reason_details")


def cause_columns(misfit: MisfitDecision | None) -> dict[str, object]:
    """Return the named cause, its effect and q."""
    return {
        "misfit_group": str(misfit.group) if misfit and misfit.group else None,
        "misfit_px": misfit.px if misfit else math.nan,
        "misfit_q": misfit.q if misfit else math.nan,
    }


def worth_columns(found: MisfitDecision | None, misfit: MisfitDiagnostics | None, sigma_px: float) -> dict[str, object]:
    """Return the cause's effect in units of the image's noise, and what the cause is worth."""
    worth = worth_of(found, misfit)
    return {
        "misfit_px_sigma": found.px / sigma_px if found and sigma_px > 0 else math.nan,
        "misfit_worth_deg": worth.rotation_deg if worth else math.nan,
        "misfit_worth_centre": worth.centre_rel if worth else math.nan,
        "misfit_worth_focal_rel": worth.focal_rel if worth else math.nan,
    }


def verdict_columns(decision: Decision) -> dict[str, object]:
    """Return the verdicts, the severity and the reasons."""
    return {
        "verdict": str(decision.verdict),
        **{name: decision.of(member) for member, name in _MEMBERS},
        "severity": decision.severity,
        "reasons": [str(reason) for reason in decision.reasons],
        "reason_details": decision.all_reasons,
    }
