"""Models with a camera that was moved after the adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.loaders.model import SparseModel


def moved_image(
    model: SparseModel, image_idx: int, turn_deg: float, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
):
    """Return the model with one camera turned about its own centre."""
    quat = model.images.quat_cam_from_world_wxyz.copy()
    translation = model.images.translation_cam_from_world.copy()
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array(axis))
    quat[image_idx] = np.roll((turn * Rotation.from_quat(np.roll(quat[image_idx], -1))).as_quat(), 1)
    translation[image_idx] = turn.apply(translation[image_idx])
    images = replace(model.images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    return replace(model, images=images)
