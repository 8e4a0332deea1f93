"""The science of sfm-audit: pure functions on arrays. Start with `audit_model`, `ModelAuditor` or `audit_inliers`.

Names are imported when they are first used: ``sfm-audit --help`` must not wait for SciPy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from audit.config import AuditConfig
    from audit.engine import ModelAudit, ModelAuditor, audit_model
    from audit.image_audit import ImageAudit, audit_inliers
    from audit.table import ModelLabels
    from audit.verdict import Judgement, Reason, ReasonCode, Verdict

__all__ = [
    "AuditConfig",
    "ImageAudit",
    "Judgement",
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
    "audit.config": ("AuditConfig",),
    "audit.engine": ("ModelAudit", "ModelAuditor", "audit_model"),
    "audit.image_audit": ("ImageAudit", "audit_inliers"),
    "audit.table": ("ModelLabels",),
    "audit.verdict": ("Judgement", "Reason", "ReasonCode", "Verdict"),
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
