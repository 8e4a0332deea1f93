"""Audit reconstructions: does the camera that each image claims explain its own inliers? This is the interface.

Names are imported when they are first used: ``sfm-audit --help`` must not wait for SciPy. The
folders ``audit``, ``loaders`` and ``reports`` of the repository are installed inside this package, so that one import
name is taken; in a checkout they are links to the folders above.
"""

from __future__ import annotations

import importlib
import zlib  # noqa: F401 - before pycolmap 4.2, whose own zlib otherwise serves Pillow 13 too, and pictures crash
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sfm_audit.audit.config import AuditConfig
    from sfm_audit.audit.decision.decisions import Decision
    from sfm_audit.audit.engine.image import ImageAudit, audit_inliers
    from sfm_audit.audit.engine.model import ModelAuditor, audit_model
    from sfm_audit.audit.engine.tables import ModelAudit
    from sfm_audit.audit.notebook.correspondences import audit_correspondences
    from sfm_audit.audit.notebook.reconstruction import audit_reconstruction
    from sfm_audit.audit.notebook.result import ImageResult, ReconstructionAudit
    from sfm_audit.audit.table import ModelLabels
    from sfm_audit.audit.table.words import Reason, ReasonCode, Verdict
    from sfm_audit.loaders.errors import LoadError
    from sfm_audit.loaders.model import SparseModel
    from sfm_audit.loaders.opening import from_pycolmap, open_model

__version__: str  # asked of the installed metadata: it stands in pyproject.toml only

__all__ = [
    "AuditConfig",
    "Decision",
    "ImageAudit",
    "ImageResult",
    "LoadError",
    "ModelAudit",
    "ModelAuditor",
    "ModelLabels",
    "Reason",
    "ReasonCode",
    "ReconstructionAudit",
    "SparseModel",
    "Verdict",
    "audit_correspondences",
    "audit_inliers",
    "audit_model",
    "audit_reconstruction",
    "from_pycolmap",
    "open_model",
]

_HOMES: Final = {
    "AuditConfig": "audit.config",
    "ImageAudit": "audit.engine.image",
    "Decision": "audit.decision.decisions",
    "LoadError": "loaders.errors",
    "ModelAudit": "audit.engine.tables",
    "ModelAuditor": "audit.engine.model",
    "ModelLabels": "audit.table",
    "Reason": "audit.table.words",
    "ReasonCode": "audit.table.words",
    "SparseModel": "loaders.model",
    "Verdict": "audit.table.words",
    "audit_inliers": "audit.engine.image",
    "audit_model": "audit.engine.model",
    "audit_correspondences": "audit.notebook.correspondences",
    "audit_reconstruction": "audit.notebook.reconstruction",
    "ImageResult": "audit.notebook.result",
    "ReconstructionAudit": "audit.notebook.result",
    "from_pycolmap": "loaders.opening",
    "open_model": "loaders.opening",
}

if not all((Path(__file__).parent / room).is_dir() for room in ("audit", "loaders", "reports")):
    raise ImportError(
        "sfm_audit: its folders audit, loaders and reports are links that this checkout does not have; "
        "git config core.symlinks true && git checkout -- sfm_audit, or pip install a wheel"
    )


if not TYPE_CHECKING:  # a type checker would take every misspelt name for Any

    def __getattr__(name: str) -> Any:
        """Import a public name from the module it lives in."""
        if name == "__version__":
            from importlib.metadata import version  # noqa: PLC0415 - costs more than all of this

            return version("sfm-audit")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = importlib.import_module(f"{__name__}.{_HOMES[name]}")
        value = getattr(module, name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
