"""Do the reprojection errors stored with the 3D points still hold? (method.md section 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.cameras import unproject
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.inliers.sanity import is_sane
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

_STALE_PX = 1e-3
_STALE_SHARE_OF_ERROR = 1e-3
_STALE_SHARE_OF_POINTS = 0.01  # fewer stale points are rounding or a late filter, not worth a finding
_DIGITS = 6  # of numbers that C++ streams write where nobody sets their precision
_SAMPLE = 3000


@dataclass(frozen=True, slots=True)
class StoredErrors:
    """Point errors as stored and recomputed, px.

    stored_mean_px: over points with a stored error (COLMAP stores -1 for none), NaN without any.
    recomputed_mean_px: mean over points of the mean reprojection error over the point's inliers; COLMAP's definition.
    recomputed_observation_mean_px: mean over inliers.
    num_stale, num_compared: points whose stored error differs by more than 1e-3 px and 0.1 %, of those with both.
    mean_change_px: recomputed - stored, mean over those.
    is_rounded: points and 2D points have six significant digits: somebody printed the model, and its errors changed.
    """

    stored_mean_px: float
    recomputed_mean_px: float
    recomputed_observation_mean_px: float
    num_stale: int
    num_compared: int
    mean_change_px: float = math.nan
    is_rounded: bool = False

    @property
    def share_stale(self) -> float:
        """num_stale / num_compared, NaN where nothing could be compared."""
        return self.num_stale / self.num_compared if self.num_compared else math.nan


def reprojection_errors_px(model: SparseModel, residuals: ModelResiduals) -> FloatArray:
    """Return the reprojection error (n,) of every inlier as COLMAP defines it, px.

    The length of the residual; for spherical cameras the angle between the rays, times width / 2 pi.
    """
    x, y = residuals.residuals_px  # inliers: at most 1e9 px
    length = np.sqrt(x * x + y * y)
    is_spherical = np.array([*(BY_ID[model_id].is_spherical for model_id in model.cameras.model_id.tolist()), False])
    for image_idx in np.flatnonzero(is_spherical[model.images.camera_idx]).tolist():
        image, rows = model.image(image_idx), residuals.rows(image_idx)
        if image.camera is None or rows.start == rows.stop:
            continue
        observed = unproject(
            image.camera.model, image.camera.params, model.observations.xy_px[residuals.observation_row[rows]]
        )
        predicted = image.cam_from_world(model.points.xyz_world[residuals.point_idx[rows]])
        sine = np.linalg.norm(np.cross(observed, predicted), axis=1)
        angle_rad = np.arctan2(sine, (observed * predicted).sum(axis=1))
        length[rows] = angle_rad * image.camera.width / (2.0 * math.pi)
    return np.asarray(length, dtype=np.float64)


def compare_stored_errors(model: SparseModel, residuals: ModelResiduals) -> StoredErrors:
    """Recompute each point's error from the inliers of its track and compare it with the stored one."""
    stored_error_px = model.points.stored_error_px
    num_points = len(stored_error_px)
    length = reprojection_errors_px(model, residuals)
    point_idx = residuals.point_idx.astype(np.intp)  # as numpy follows them: once, not at every call
    count = np.bincount(point_idx, minlength=num_points)
    total = np.bincount(point_idx, weights=length, minlength=num_points)
    del point_idx
    seen = count > 0
    recomputed = total[seen] / count[seen]
    has_stored = (stored_error_px >= 0) & is_sane(stored_error_px)
    comparable = has_stored[seen]
    change = (recomputed - stored_error_px[seen])[comparable]
    stale = (np.abs(change) > _STALE_PX) & (np.abs(change) > _STALE_SHARE_OF_ERROR * recomputed[comparable])
    return StoredErrors(
        float(stored_error_px[has_stored].mean()) if has_stored.any() else math.nan,
        float(recomputed.mean()) if recomputed.size else math.nan,
        float(length.mean()) if length.size else math.nan,
        int(np.count_nonzero(stale)),
        int(np.count_nonzero(comparable)),
        float(change.mean()) if change.size else math.nan,
        _is_rounded(model.points.xyz_world) and _is_rounded(model.observations.xy_px),
    )


def _is_rounded(values: FloatArray) -> bool:
    """Whether an even sample of the values has six significant digits or fewer, and not all are whole numbers."""
    flat = values.reshape(-1)
    sample = flat[:: max(1, flat.size // _SAMPLE)]
    return bool(np.any(sample != np.round(sample))) and all(float(f"{v:.{_DIGITS}g}") == v for v in sample.tolist())


def stale_finding(errors: StoredErrors) -> Finding | None:
    """Return the finding where more than one in a hundred stored errors does not hold.

    A model printed with six digits has other errors than the one that was printed: +-0.005 px at x = 1000. They are
    not called stale where their mean still holds, to 1e-3 px or 0.1 %.
    """
    if not errors.num_compared or errors.share_stale <= _STALE_SHARE_OF_POINTS:
        return None
    tolerance_px = max(_STALE_PX, _STALE_SHARE_OF_ERROR * errors.recomputed_mean_px)
    if errors.is_rounded and abs(errors.mean_change_px) <= tolerance_px:
        return None
    return Finding(
        FindingCode.STORED_ERRORS_STALE,
        errors.num_stale,
        f"{errors.num_stale} of {errors.num_compared} stored point errors do not match the model: "
        f"mean {errors.stored_mean_px:.4g} px stored, {errors.recomputed_mean_px:.4g} px recomputed",
    )
