"""What is left of an image's residuals after one linear step of its own pose? (method.md section 12)."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.cameras import project, project_with_jacobians
from sfm_audit.audit.consistency.affine import median_of, robust_weights
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import CameraRecord

_ROUNDS: Final = 5  # of weights; the step itself is one
_MIN_SHARE: Final = 0.8  # of the points have to project after the step
_RELATIVE_CUT: Final = 1e-9  # of the largest eigenvalue of the unit columns' Gram matrix


def residuals_of(camera: CameraRecord, xy_px: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Return (2, n) observed - projected px of (n, 2), (n, 3); NaN where a point does not project."""
    residuals = xy_px.T - project(camera.model, camera.params, xyz_cam).T
    if camera.model.is_spherical:
        residuals[0] -= camera.width * np.round(residuals[0] / camera.width)  # the seam is no edge
    return np.asarray(residuals)


def lengths_after_pose_step(
    camera: CameraRecord, xy_px: FloatArray, xyz_cam: FloatArray, residuals_px: FloatArray
) -> FloatArray | None:
    """Return the lengths (m,) px of the residuals after one robust Gauss-Newton step of the pose.

    Parameters
    ----------
    xy_px : (n, 2)    xyz_cam : (n, 3) in front    residuals_px : (2, n) as the model stands, finite

    Returns
    -------
    (m,)
        None where no step can be taken, where it does not lower the median length, or where fewer than 80 % of the
        points would project after it.

    Notes
    -----
    The step is taken and the points are projected again. One step only: a pose off by a few degrees is brought home
    by it (`pose_not_optimal` says so), while several would let every camera of a model whose points have another scale
    walk to where its own points fit, and hide that the parts do not belong together.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - most models have no image that needs it

    with np.errstate(all="ignore"):
        jacobian = project_with_jacobians(camera.model, camera.params, xyz_cam, with_params=False).d_xy_d_cam
        columns = pose_columns(jacobian.transpose(1, 2, 0), xyz_cam)
        used = np.isfinite(columns).all(axis=(0, 1))
        columns, target = columns[:, :, used], residuals_px[:, used]
        norms = np.sqrt((columns**2).sum(axis=(1, 2)))
        if np.count_nonzero(used) < len(columns) or not np.isfinite(norms).all() or not norms.any():
            return None
        norms[norms == 0] = 1.0
        step = _robust_step(columns / norms[:, None, None], target) / norms
        if not np.isfinite(step).all():
            return None
        moved = xyz_cam @ Rotation.from_rotvec(step[:3]).as_matrix().T + step[3:]
        if not camera.model.is_spherical:
            moved[moved[:, 2] <= 0] = np.nan
        after: FloatArray = np.hypot(*residuals_of(camera, xy_px, moved))
        after = after[np.isfinite(after)]
    before: FloatArray = np.hypot(*residuals_px)
    if after.size < _MIN_SHARE * before.size or median_of(after) > median_of(before):
        return None
    return after


def _robust_step(columns: FloatArray, target: FloatArray) -> FloatArray:
    """Weighted least squares (6,) of unit columns (6, 2, n) to (2, n), with Cauchy weights of what is left."""
    rest: FloatArray = target
    step: FloatArray = np.zeros(len(columns))
    flat = columns.reshape(len(columns), -1)
    for _ in range(_ROUNDS):
        length: FloatArray = np.hypot(*rest)
        weighted = (columns * robust_weights(length, median_of(length))).reshape(len(columns), -1)
        gram = weighted @ flat.T
        if not np.isfinite(gram).all():
            return np.full(len(columns), np.nan)
        step = np.asarray(np.linalg.lstsq(gram, weighted @ target.ravel(), rcond=_RELATIVE_CUT)[0], dtype=np.float64)
        rest = target - (step @ flat).reshape(target.shape)
    return step
