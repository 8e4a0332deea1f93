"""Where a simulated board stands: what placing it, scanning it and photographing it share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.loaders.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """Where a board stands, and where its corners are seen: rotation (3, 3), translation (3,), xy_px (n, 2)."""

    rotation_cam_from_world: FloatArray
    translation_cam_from_world: FloatArray
    xy_px: FloatArray

    def xyz_cam(self, xyz_world: FloatArray) -> FloatArray:
        """Return points (n, 3) in the camera frame."""
        return np.asarray(xyz_world @ self.rotation_cam_from_world.T + self.translation_cam_from_world)
