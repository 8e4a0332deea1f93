"""The science of sfm-audit: pure functions on arrays. Start with `audit_model`, `ModelAuditor` or `audit_inliers`.

Names are imported when they are first used: ``sfm-audit --help`` must not wait for SciPy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sfm_audit.audit.config import AuditConfig
    from sfm_audit.audit.decision.decisions import Decision
    from sfm_audit.audit.engine.image import ImageAudit, audit_inliers
    from sfm_audit.audit.engine.model import ModelAuditor, audit_model
    from sfm_audit.audit.engine.tables import ModelAudit
    from sfm_audit.audit.table import ModelLabels
    from sfm_audit.audit.table.words import Reason, ReasonCode, Verdict

__all__ = [
    "AuditConfig",
    "Decision",
    "ImageAudit",
    "ModelAudit",
    "ModelAuditor",
    "ModelLabels",
    "Reason",
    "ReasonCode",
    "Verdict",
    "audit_inliers",
    "audit_model",
]

_HOMES: Final = {
    "sfm_audit.audit.config": ("AuditConfig",),
    "sfm_audit.audit.engine.model": ("ModelAuditor", "audit_model"),
    "sfm_audit.audit.engine.tables": ("ModelAudit",),
    "sfm_audit.audit.engine.image": ("ImageAudit", "audit_inliers"),
    "sfm_audit.audit.table": ("ModelLabels",),
    "sfm_audit.audit.decision.decisions": ("Decision",),
    "sfm_audit.audit.table.words": ("Reason", "ReasonCode", "Verdict"),
}


def __getattr__(name: str) -> Any:
    """Import a public name from the module it lives in."""
    for module, names in _HOMES.items():
        if name in names:
            value = getattr(importlib.import_module(module), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
