"""Images that stay clear of every limit, asked all at once; the others are asked one by one, in `image`."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sfm_audit.audit.consistency.affine import KNEE, MEDIAN_LENGTH, AffineFit
from sfm_audit.audit.consistency.image import ConsistencyLimits, ImageConsistency, half_pixel
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.inliers.sanity import usable_cameras
from sfm_audit.audit.kernels.consistency import AFFINE, NOTHING, RMS, Fitted, fit_images
from sfm_audit.loaders.arrays import BoolArray, IntArray
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import SparseModel

_CLEAR: Final = 1.0 - 1e-6
"""Share of a limit up to which rounding cannot matter."""


def clear_images(
    model: SparseModel, residuals: ModelResiduals, limits: ConsistencyLimits
) -> list[ImageConsistency | None]:
    """Return what `image.consistency_of_linked` would say of images that are clear of all limits; None for the others.

    Those are images without a usable camera or with few observations, and those that the compiled kernel finds well
    below every limit.
    """
    num = np.diff(residuals.offsets)
    num_linked = num + residuals.num_behind + residuals.num_unprojected
    shares = np.where(num_linked > 0, (num_linked - residuals.num_behind) / np.maximum(num_linked, 1), np.nan)
    has_camera, is_flat, width = _cameras(model)
    is_asked = has_camera & (num_linked >= limits.min_observations)
    found: list[ImageConsistency | None] = [None] * len(num)
    names, camera_ids = model.images.name, model.images.camera_id.tolist()
    for image_idx in np.flatnonzero(~is_asked).tolist():
        known = (int(num_linked[image_idx]), float(shares[image_idx])) if has_camera[image_idx] else (0, math.nan)
        found[image_idx] = ImageConsistency(names[image_idx], camera_ids[image_idx], *known)
    fitted = fit_images(
        residuals.offsets,
        np.ascontiguousarray(residuals.residuals_px),
        residuals.observation_row,
        np.ascontiguousarray(model.observations.xy_px),
        wanted=np.where(is_asked & (num >= limits.min_observations), np.where(is_flat, AFFINE, RMS), NOTHING),
        knee=KNEE,
    )
    if fitted is None:
        return found
    is_clear = fitted.done & _is_clear(fitted, is_flat, width, limits)
    is_clear &= residuals.num_behind < _CLEAR * limits.max_share_wrong * num_linked
    for image_idx in np.flatnonzero(is_clear).tolist():
        rms_px = float(fitted.stored_rms[image_idx])
        affine = _affine(fitted, image_idx, int(num[image_idx])) if is_flat[image_idx] else None
        found[image_idx] = ImageConsistency(
            names[image_idx],
            camera_ids[image_idx],
            int(num_linked[image_idx]),
            float(shares[image_idx]),
            rms_px,
            rms_px,
            affine,
            inconsistent=False,
            half_pixel=half_pixel(affine, limits),
        )
    return found


def _cameras(model: SparseModel) -> tuple[BoolArray, BoolArray, IntArray]:
    """By image: whether its camera can be used and has a size, whether it is no panorama, and its width."""
    cameras, images = model.cameras, model.images
    if not len(cameras):
        nothing = np.zeros(len(images), dtype=np.bool_)
        return nothing, nothing, np.zeros(len(images), dtype=np.int64)
    is_usable = usable_cameras(cameras) & (np.minimum(cameras.width, cameras.height) > 0)
    is_flat = np.array([not BY_ID[model_id].is_spherical for model_id in cameras.model_id.tolist()])
    idx = images.camera_idx
    return is_usable[idx] & (idx >= 0), is_flat[idx], cameras.width[idx]


def _is_clear(fitted: Fitted, is_flat: BoolArray, width: IntArray, limits: ConsistencyLimits) -> BoolArray:
    """(I,) whether the RMS is below the limits of `image` from which the pose's own step is asked."""
    rms_px = fitted.stored_rms
    of_rest = np.maximum(limits.min_rms_px, limits.max_rms_ratio * fitted.rest_rms)
    return np.asarray((rms_px < _CLEAR * limits.max_rms_share * width) & (~is_flat | (rms_px < _CLEAR * of_rest)))


def _affine(fitted: Fitted, image_idx: int, num: int) -> AffineFit:
    """The fit of one image, as `affine.fit_affine` gives it."""
    slope, shift, mean = fitted.slope[image_idx], fitted.shift[image_idx], fitted.centre[image_idx]
    noise_px = float(fitted.median[image_idx]) / MEDIAN_LENGTH
    return AffineFit(
        np.eye(2) + slope,
        shift - slope @ mean,
        mean,
        shift,
        noise_px / math.sqrt(num),
        fitted.spread[image_idx],
        noise_px,
        float(fitted.rest_rms[image_idx]),
    )
