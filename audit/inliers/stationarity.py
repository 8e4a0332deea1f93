"""Is the pose at the optimum of its own residuals? (method.md section 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_SMALLEST_PIVOT = 1e-10  # of the Gram matrix of unit columns; below it the orthonormal basis is taken by SVD


def pose_columns(jacobian_cam: FloatArray, xyz_cam: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Return (6, 2, n): d projection / d (rotation, translation), left perturbation in the camera frame.

    Parameters
    ----------
    jacobian_cam : (2, 3, n) d projection / d point in the camera frame, px per model unit
    xyz_cam : (n, 3) points in the camera frame, model units
    out : (6, 2, n) where they go; an array of their own when None

    Notes
    -----
    A rotation by the small vector w (rad) about the camera centre moves a point by w x Xc, a translation t by t.
    """
    x, y, z = xyz_cam.T
    jx, jy, jz = jacobian_cam.transpose(1, 0, 2)
    out = np.empty((6, *jx.shape)) if out is None else out
    for place, (a, b, along_a, along_b) in enumerate(((jz, jy, y, z), (jx, jz, z, x), (jy, jx, x, y))):
        np.multiply(a, along_a, out=out[place])
        out[place] -= b * along_b
    out[3:] = jacobian_cam.transpose(1, 0, 2)
    return out


def pose_jacobian(jacobian_cam: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Return (n, 2, 6): `pose_columns` with points first, of (n, 2, 3) and (n, 3)."""
    return pose_columns(jacobian_cam.transpose(1, 2, 0), xyz_cam).transpose(2, 1, 0)


def pose_offset_px(residuals_px: FloatArray, jacobian_cam: FloatArray, xyz_cam: FloatArray) -> float:
    """Return |Q_pose^T y| / sqrt n: the RMS length, px, of what moving the pose alone would remove.

    Parameters
    ----------
    residuals_px : (2, n) observed - projected        jacobian_cam, xyz_cam : as in `pose_columns`

    Returns
    -------
    float
        px; NaN without observations. A bundle-adjusted image has ~0, a pose changed afterwards 1..3.
    """
    return offset_px(pose_columns(jacobian_cam, xyz_cam), residuals_px)


def offset_px(columns: FloatArray, residuals_px: FloatArray) -> float:
    """Return the same of any six pose columns (6, 2, n) and residuals (2, n): of an image, or of a frame of images."""
    n = residuals_px.shape[1]
    if n == 0:
        return math.nan
    columns = columns.reshape(6, 2 * n)
    gram = columns @ columns.T
    if not np.isfinite(gram).all():  # at the poles of a panorama: such a point does not move the pose
        columns = np.where(np.isfinite(columns).all(axis=0), columns, 0.0)
        gram = columns @ columns.T
    used = gram.diagonal() > 0
    if not used.any():  # nothing that the pose does moves a point
        return math.nan
    norms = np.sqrt(gram.diagonal()[used])
    y = residuals_px.reshape(2 * n)
    right = (columns @ y)[used] / norms
    try:
        factor = np.linalg.cholesky(gram[np.ix_(used, used)] / norms / norms[:, None])
    except np.linalg.LinAlgError:
        factor = np.zeros((1, 1))
    if factor.diagonal().min() ** 2 > _SMALLEST_PIVOT:
        projected = np.linalg.solve(factor, right)
    else:
        basis, singular, _ = np.linalg.svd(columns[used].T / norms, full_matrices=False)
        projected = basis[:, singular > 1e-9 * singular[0]].T @ y
    return float(np.sqrt(projected @ projected / n))


def offsets_of_sums(gram: FloatArray, right: FloatArray, num_points: IntArray) -> tuple[FloatArray, BoolArray]:
    """Return `offset_px` (I,) of images of which only sums are known, and which of them are well above rounding.

    Parameters
    ----------
    gram, right : (I, 6, 6) and (I, 6), products of the pose columns with each other and with the residuals
    num_points : (I,) observations

    Notes
    -----
    Cholesky's factor of the unit columns' Gram matrix, and what it leaves of the right-hand side, of all images at
    once; an image whose matrix has none gets NaN and is not sure.
    """
    with np.errstate(all="ignore"):
        norms = np.sqrt(np.diagonal(gram, axis1=1, axis2=2))
        factor = np.array((gram / norms[:, None, :] / norms[:, :, None]).transpose(1, 2, 0))  # images last
        projected = np.array((right / norms).T)
        smallest = np.full(len(gram), np.inf)
        for column in range(len(projected)):
            pivot = factor[column, column] - (factor[column, :column] ** 2).sum(axis=0)
            smallest = np.minimum(smallest, pivot)
            root = np.sqrt(pivot)
            rest = factor[column + 1 :, column]
            rest -= (factor[column + 1 :, :column] * factor[column, :column]).sum(axis=1)
            rest /= root
            factor[column, column] = root
            projected[column] = (projected[column] - (factor[column, :column] * projected[:column]).sum(axis=0)) / root
        offsets = np.sqrt((projected**2).sum(axis=0) / num_points)
    return offsets, np.asarray((smallest > _SMALLEST_PIVOT) & np.isfinite(offsets))


def pose_offsets_px(parts: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> list[float]:
    """Return `pose_offset_px` of several images with equally many observations, to the last bit.

    Parameters
    ----------
    parts : residuals (2, n), Jacobian (2, 3, n) and points (n, 3) of each

    Notes
    -----
    Images whose columns are not all well above rounding are left to it.
    """
    num_images, num_points = len(parts), parts[0][0].shape[1]
    if not num_points or num_images == 1:
        return [pose_offset_px(*part) for part in parts]
    residuals, jacobians, points = zip(*parts, strict=True)
    joined = pose_columns(np.concatenate(jacobians, axis=2), np.concatenate(points))
    by_image = np.ascontiguousarray(joined.reshape(6, 2, num_images, num_points).transpose(2, 0, 1, 3))
    columns = by_image.reshape(num_images, 6, 2 * num_points)
    gram = columns @ columns.swapaxes(1, 2)
    squares = np.diagonal(gram, axis1=1, axis2=2)
    if not np.isfinite(gram).all() or not (squares > 0).all():
        return [pose_offset_px(*part) for part in parts]
    norms = np.sqrt(squares)
    y = np.stack(residuals).reshape(num_images, 2 * num_points, 1)
    right = (columns @ y)[:, :, 0] / norms
    try:
        factor = np.linalg.cholesky(gram / norms[:, None, :] / norms[:, :, None])
    except np.linalg.LinAlgError:
        return [pose_offset_px(*part) for part in parts]
    is_sure = np.diagonal(factor, axis1=1, axis2=2).min(axis=1) ** 2 > _SMALLEST_PIVOT
    projected = np.linalg.solve(factor, right[:, :, None])[:, :, 0]
    return [
        math.sqrt(own @ own / num_points) if sure else pose_offset_px(*part)
        for own, sure, part in zip(projected, is_sure.tolist(), parts, strict=True)
    ]
