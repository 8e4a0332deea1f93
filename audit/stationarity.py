"""Is the pose at the optimum of its own residuals? (METHOD.md section 6)."""

from __future__ import annotations

import math

import numpy as np

from loaders.arrays import FloatArray

_SMALLEST_PIVOT = 1e-10  # of the Gram matrix of unit columns; below it the orthonormal basis is taken by SVD


def pose_jacobian(jacobian_cam: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Return (n, 2, 6): d projection / d (rotation, translation), left perturbation in the camera frame.

    Parameters
    ----------
    jacobian_cam : (n, 2, 3) d projection / d point in the camera frame, px per model unit
    xyz_cam : (n, 3) points in the camera frame, model units

    Notes
    -----
    A rotation by the small vector w (rad) about the camera centre moves a point by w x Xc, a translation t by t.
    """
    x, y, z = (xyz_cam[:, i, None] for i in range(3))
    jx, jy, jz = (jacobian_cam[:, :, i] for i in range(3))
    out = np.empty((len(xyz_cam), 2, 6))
    out[:, :, 0] = jz * y - jy * z
    out[:, :, 1] = jx * z - jz * x
    out[:, :, 2] = jy * x - jx * y
    out[:, :, 3:] = jacobian_cam
    return out


def pose_offset_px(residuals_px: FloatArray, jacobian_cam: FloatArray, xyz_cam: FloatArray) -> float:
    """Return |Q_pose^T y| / sqrt n: the RMS length, px, of what moving the pose alone would remove.

    Parameters
    ----------
    residuals_px : (n, 2) observed - projected        jacobian_cam, xyz_cam : as in `pose_jacobian`

    Returns
    -------
    float
        px; NaN without observations. A bundle-adjusted image has ~0, a pose changed afterwards 1..3.
    """
    n = len(residuals_px)
    if n == 0:
        return math.nan
    columns = pose_jacobian(jacobian_cam, xyz_cam).reshape(2 * n, 6)
    norms = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    if not np.isfinite(norms).all():  # at the poles of a panorama: such a point does not move the pose
        columns = np.where(np.isfinite(columns).all(axis=1, keepdims=True), columns, 0.0)
        norms = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    columns = columns[:, norms > 0] / norms[norms > 0]
    y = residuals_px.reshape(2 * n)
    gram = columns.T @ columns
    try:
        factor = np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        factor = np.zeros((1, 1))
    if factor.diagonal().min() ** 2 > _SMALLEST_PIVOT:
        projected = np.linalg.solve(factor, columns.T @ y)
    else:
        basis, singular, _ = np.linalg.svd(columns, full_matrices=False)
        projected = basis[:, singular > 1e-9 * singular[0]].T @ y
    return float(np.sqrt(projected @ projected / n))
