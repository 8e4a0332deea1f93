"""Would the image fit if its pose, or the scale of the points, were read in another way? (method.md section 12)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import unproject
from sfm_audit.audit.consistency.cause import CAUSE_MEANINGS, Cause, Explanation
from sfm_audit.audit.consistency.pose_step import residuals_of
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import CameraRecord, ImageRecord

_MIN_SHARE: Final = 0.8  # of the points have to be in front and project
_FLIPPED: Final = np.array([1.0, -1.0, -1.0])


def fitting_reading(
    image: ImageRecord, camera: CameraRecord, xy_px: FloatArray, xyz_world: FloatArray, tolerance_px: float
) -> Explanation | None:
    """Return the first other reading under which the image's points fit; None where there is none.

    Parameters
    ----------
    xy_px, xyz_world : (n, 2), (n, 3) linked points, finite, those behind the camera included
    tolerance_px : median length of the residuals up to which a reading fits

    Notes
    -----
    method.md section 12 calls all of these "poses or points"; a reading is named only when it was tried and at least
    80 % of the points are in front of the camera and half of all within the tolerance, which does not happen by chance.
    """
    with np.errstate(all="ignore"):
        for explanation, xyz_cam in _readings(image, camera, xy_px, xyz_world):
            if _fits(camera, xy_px, xyz_cam, tolerance_px):
                return explanation
    return None


def _readings(
    image: ImageRecord, camera: CameraRecord, xy_px: FloatArray, xyz_world: FloatArray
) -> Iterator[tuple[Explanation, FloatArray]]:
    """Explanations and the points in the camera frame under them."""
    as_stored = image.cam_from_world(xyz_world)
    yield _explained(Cause.CAMERA_AXES), as_stored * _FLIPPED
    rotation, translation = image.rotation_cam_from_world, image.translation_cam_from_world
    inverted = (xyz_world - translation) @ rotation
    yield _explained(Cause.INVERTED_POSES), inverted
    both = f"{CAUSE_MEANINGS[Cause.INVERTED_POSES]}, and {CAUSE_MEANINGS[Cause.CAMERA_AXES]}"
    yield Explanation(Cause.INVERTED_POSES, both), inverted * _FLIPPED
    wxyz = image.quat_cam_from_world_wxyz[[3, 0, 1, 2]]
    yield _explained(Cause.QUATERNION_ORDER), replace(image, quat_cam_from_world_wxyz=wxyz).cam_from_world(xyz_world)
    factor = _point_factor(camera, xy_px, as_stored, translation)
    if factor > 0 and np.isfinite(factor):
        text = f"3D points are {1.0 / factor:.4g} x as large as the poses say"
        yield Explanation(Cause.POINT_SCALE, text), factor * (as_stored - translation) + translation


def _explained(cause: Cause) -> Explanation:
    return Explanation(cause, CAUSE_MEANINGS[cause])


def _point_factor(camera: CameraRecord, xy_px: FloatArray, xyz_cam: FloatArray, translation: FloatArray) -> float:
    """By which factor the points would have to be multiplied: the median over points of ray x (factor R X + t) = 0."""
    rays = unproject(camera.model, camera.params, xy_px)
    of_points, of_pose = np.cross(rays, xyz_cam - translation), np.cross(rays, translation)
    factors = -(of_points * of_pose).sum(axis=1) / (of_points**2).sum(axis=1)
    factors = factors[np.isfinite(factors)]
    return float(np.median(factors)) if factors.size else float("nan")


def _fits(camera: CameraRecord, xy_px: FloatArray, xyz_cam: FloatArray, tolerance_px: float) -> bool:
    """Whether enough points are in front, and half of them close to where they were observed."""
    xyz_cam = xyz_cam if camera.model.is_spherical else np.where(xyz_cam[:, 2:] > 0, xyz_cam, np.nan)
    length = np.hypot(*residuals_of(camera, xy_px, xyz_cam))
    length = length[np.isfinite(length)]
    return bool(length.size >= _MIN_SHARE * len(xy_px) and np.median(length) <= tolerance_px)
