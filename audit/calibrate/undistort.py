"""What would a camera without distortion have seen? Needs the extra ``calibrate`` (OpenCV)."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_audit.audit.calibrate.camera import CalibratedCamera
from sfm_audit.loaders.arrays import FloatArray

_BLOCK_PIXELS: Final = 1 << 18  # projected at once, so that derivatives nobody needs do not fill the memory
_NOWHERE: Final = -1e4  # outside of any image: cv2.remap takes no NaN


def undistort_map(camera: CalibratedCamera) -> FloatArray:
    """Return (height, width, 2) px: where in the photo each pixel of the undistorted image lies; NaN where nowhere.

    The undistorted camera has the same size, focal lengths and principal point. First pixel centre = (0.5, 0.5).
    """
    x = (np.arange(camera.width) + 0.5 - camera.principal_point_px[0]) / camera.focal_px[0]
    y = (np.arange(camera.height) + 0.5 - camera.principal_point_px[1]) / camera.focal_px[1]
    rows = max(1, _BLOCK_PIXELS // camera.width)
    blocks = []
    for start in range(0, camera.height, rows):
        u = np.stack(np.meshgrid(x, y[start : start + rows]), axis=-1)
        rays = np.concatenate([u, np.ones((*u.shape[:2], 1))], axis=-1).reshape(-1, 3)
        blocks.append(camera.project(rays).xy_px.T.reshape(u.shape))
    return np.concatenate(blocks)


def undistort_image(photo: NDArray[np.uint8], camera: CalibratedCamera) -> NDArray[np.uint8]:
    """Resample a photo (height, width) or (height, width, channels), bilinearly; black where the photo has nothing.

    Raises
    ------
    ValueError
        The photo has another size than the camera.
    """
    if photo.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"photo of {photo.shape[1]} x {photo.shape[0]} px, camera of {camera.width} x {camera.height}")
    source = undistort_map(camera) - 0.5  # cv2: first pixel centre = (0, 0)
    where: Any = np.where(np.isfinite(source), source, _NOWHERE).astype(np.float32)
    return np.asarray(cv2.remap(photo, where[..., 0], where[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)
