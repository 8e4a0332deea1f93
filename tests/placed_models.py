"""Models placed by rigs and frames whose images file has other poses, on purpose: it is not read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sfm_audit.loaders import FindingCode, SparseModel
from sfm_audit.loaders import open_model as open_any


def open_model(folder: Path) -> SparseModel:
    """Open a model; that the images file has other poses is no matter of these tests (test_rig_poses.py)."""
    model = open_any(folder)
    return replace(model, findings=tuple(f for f in model.findings if f.code is not FindingCode.RIG_POSE_DISAGREES))
