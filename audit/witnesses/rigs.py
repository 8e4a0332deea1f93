"""Is a rig rigid? Would images move against the frame that places them? A finding (method.md section 13)."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.stationarity import pose_offset_px
from sfm_audit.audit.table.thresholds import MAX_POSE_OFFSET_PX, MIN_OBSERVATIONS
from sfm_audit.audit.witnesses.evidence import Evidence, WitnessReport
from sfm_audit.loaders.model import Finding, FindingCode

_LIMIT_PX: Final = MAX_POSE_OFFSET_PX.default  # as for images that no rig places (verdict_pose)
_MIN_INLIERS: Final = int(MIN_OBSERVATIONS.default)


def ask_rigs(evidence: Evidence) -> WitnessReport | None:
    """Return the cameras of a rig whose images would move against their frames; None where no rig is claimed.

    The frame's pose is at its optimum over all of its images; where relative poses are not constant, or not where the
    rig has them, each image alone would still move.
    """
    model, residuals = evidence.model, evidence.residuals
    if model.images.frame_idx is None:
        return None
    offset_px = np.full(len(model.images), np.nan)
    for image_idx in range(len(model.images)):
        rows = residuals.rows(image_idx)
        if rows.stop - rows.start >= _MIN_INLIERS:
            own = image_inliers(model, residuals, image_idx)
            offset_px[image_idx] = pose_offset_px(own.residuals_px, own.jacobian_cam, own.xyz_cam)
    moved = offset_px > _LIMIT_PX
    asked = np.isfinite(offset_px)
    said = []
    for camera_id in np.unique(model.images.camera_id[moved]).tolist():
        of = asked & (model.images.camera_id == camera_id)
        num, total = int((moved & of).sum()), int(of.sum())
        if 2 * num > total:
            said.append(f"camera {camera_id} in {num} of {total} frames (median {np.median(offset_px[of]):.2f} px)")
    columns = {"rig_offset_px": offset_px}
    if not said:
        return WitnessReport(None, (), columns)
    text = f"relative poses are not constant, or not where the rig has them: {', '.join(said)} would move alone"
    return WitnessReport(None, (), columns, (Finding(FindingCode.RIG_NOT_CONSTANT, len(said), text),))
