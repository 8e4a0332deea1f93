"""From points in the camera frame to pixels, with derivatives, for every camera model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from sfm_audit.audit.cameras.columns import Column, Plane, Want, in_front
from sfm_audit.audit.cameras.fisheye import angle_gain
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Projected points; row i of every array is the same point, and all of it is NaN where it does not project.

    xy_px: (n, 2) px, distorted image, first pixel centre = (0.5, 0.5).
    d_xy_d_cam: (n, 2, 3) px per model unit, d xy / d point in the camera frame.
    d_xy_d_params: (n, 2, p) px per unit of each parameter, in COLMAP's parameter order; None when not asked for.
    """

    xy_px: FloatArray
    d_xy_d_cam: FloatArray
    d_xy_d_params: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionColumns:
    """A `Projection` with points last, contiguous: xy_px (2, n), d_xy_d_cam (2, 3, n), d_xy_d_params (p, 2, n)."""

    xy_px: FloatArray
    d_xy_d_cam: FloatArray
    d_xy_d_params: FloatArray | None


def is_fisheye(model: CameraModel) -> bool:
    """Whether ``model`` distorts the equidistant plane theta (X, Y) / rho instead of (X, Y) / Z."""
    return functions_of(model).is_fisheye


def project(model: CameraModel, params: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Project points, as COLMAP does.

    Parameters
    ----------
    model : CameraModel
    params : (p,)       in COLMAP's order, px and dimensionless
    xyz_cam : (n, 3)    points in the camera frame, model units

    Returns
    -------
    (n, 2)
        px in the distorted image; NaN where pycolmap's ``Camera.img_from_cam`` gives no finite pixel: Zc below the
        machine epsilon (all models but the division models and EQUIRECTANGULAR), outside the domain of a division
        model or of EUCM, no direction at all (EQUIRECTANGULAR), overflow, points that are not finite.

    Raises
    ------
    ValueError
        when the shapes are not (p,) and (n, 3).

    Notes
    -----
    method.md section 1 asks of an inlier that Zc > 0 *and* a finite projection. The first is the caller's question:
    a division model with k < 0 has finite projections of points behind the camera.

    Source: COLMAP 4.2, src/colmap/sensor/models.h.
    """
    with np.errstate(all="ignore"):
        plane = _plane(model, params, xyz_cam, Want.VALUE)
        return np.ascontiguousarray(_finite_px(model, params, plane)[0].T)


def project_with_jacobians(
    model: CameraModel, params: FloatArray, xyz_cam: FloatArray, *, with_params: bool = True
) -> Projection:
    """Project points, with analytic derivatives; see ``project`` for arguments, domain and errors.

    ``with_params=False`` leaves out ``d_xy_d_params``, the dearer half.

    Some points project and have no finite derivative: the poles of EQUIRECTANGULAR, the rim of a division model
    (Z^2 = 4 k (X^2 + Y^2)), and points at infinity.
    """
    found = project_columns(model, params, xyz_cam, with_params=with_params)
    d_params = found.d_xy_d_params
    return Projection(
        np.ascontiguousarray(found.xy_px.T),
        np.ascontiguousarray(found.d_xy_d_cam.transpose(2, 0, 1)),
        None if d_params is None else np.ascontiguousarray(d_params.transpose(2, 1, 0)),
    )


def project_columns(
    model: CameraModel, params: FloatArray, xyz_cam: FloatArray, *, with_params: bool = True
) -> ProjectionColumns:
    """Do what ``project_with_jacobians`` does, points last: for those who go on with one number of all points.

    ``params`` may be (p, n), where every point has a camera of its own; not for FOV, which asks what omega is.
    """
    with np.errstate(all="ignore"):
        plane = _plane(model, params, xyz_cam, Want.D_EXTRA if with_params else Want.D_POINT)
        xy_px, lost = _finite_px(model, params, plane)
        d_cam = _d_cam(model, params, plane)
        d_params = _d_params(model, params, plane) if with_params else None
    if lost is not None:
        d_cam[..., lost] = np.nan
        if d_params is not None:
            d_params[..., lost] = np.nan
    return ProjectionColumns(xy_px, d_cam, d_params)


def normalised(model: CameraModel, params: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Return the undistorted normalised point, method.md section 5's u.

    Parameters as in ``project``; ``params`` do not matter and are there so that the three functions look alike.

    Returns
    -------
    (n, 2)
        (X, Y) / Z, for fisheye models theta (X, Y) / rho; NaN where Zc is below the machine epsilon, and everywhere
        for spherical models.
    """
    del params
    if model.is_spherical:
        return np.full((len(xyz_cam), 2), np.nan)
    with np.errstate(all="ignore"):
        xy = xyz_cam[:, :2] / in_front(xyz_cam[:, 2])[:, None]
        if is_fisheye(model):
            xy *= angle_gain((xy * xy).sum(axis=1))[:, None]
    return xy


def distorted_normalised(model: CameraModel, params: FloatArray, xyz_cam: FloatArray) -> FloatArray:
    """Return ((x - cx) / fx, (y - cy) / fy) of the projected points, method.md section 5's v.

    Parameters as in ``project``. (n, 2), NaN where ``project`` is NaN, and everywhere for spherical models.
    """
    if model.is_spherical:
        return np.full((len(xyz_cam), 2), np.nan)
    with np.errstate(all="ignore"):
        plane = _plane(model, params, xyz_cam, Want.VALUE)
        _, lost = _finite_px(model, params, plane)
    xy = np.column_stack([plane.x, plane.y])
    if lost is not None:
        xy[lost] = np.nan
    return xy


def scale_and_shift(model: CameraModel, params: FloatArray) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy (w, h, 0, 0 for spherical models), px."""
    if model.is_spherical:
        return float(params[0]), float(params[1]), 0.0, 0.0
    focals, centre = model.focal_idxs, model.principal_point_idxs
    return float(params[focals[0]]), float(params[focals[-1]]), float(params[centre[0]]), float(params[centre[1]])


def extra_params(model: CameraModel, params: FloatArray) -> list[float]:
    """Return the distortion parameters, in COLMAP's order."""
    return [float(params[i]) for i in model.extra_idxs]


def check_shapes(model: CameraModel, params: FloatArray, rows: FloatArray, width: int) -> None:
    """Raise ValueError unless ``params``, (p,) or (p, n), fits ``model`` and ``rows`` is (n, width)."""
    if params.shape not in {(model.num_params,), (model.num_params, len(rows))}:
        raise ValueError(f"{model.name} has {model.num_params} parameters, got an array of shape {params.shape}")
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"expected points of shape (n, {width}), got {rows.shape}")


def scales_and_shifts(model: CameraModel, params: FloatArray) -> tuple[Column, Column, Column, Column]:
    """Return `scale_and_shift` of (p,) parameters, and (n,) each of (p, n), where every point has its own."""
    if params.ndim == 1:
        return scale_and_shift(model, params)
    if model.is_spherical:
        return params[0], params[1], 0.0, 0.0
    focals, centre = model.focal_idxs, model.principal_point_idxs
    return params[focals[0]], params[focals[-1]], params[centre[0]], params[centre[1]]


def extras(model: CameraModel, params: FloatArray) -> Sequence[float]:
    """Return `extra_params` of (p,) parameters, and (n,) each of (p, n): to the distortions both are numbers."""
    if params.ndim == 1:
        return extra_params(model, params)
    return cast("Sequence[float]", [params[i] for i in model.extra_idxs])


def _plane(model: CameraModel, params: FloatArray, xyz_cam: FloatArray, want: Want) -> Plane:
    """Return the points on the model's distorted normalised plane; spherical models: as shares of the image."""
    check_shapes(model, params, xyz_cam, 3)
    x, y, z = xyz_cam[:, 0], xyz_cam[:, 1], xyz_cam[:, 2]
    return functions_of(model).plane(x, y, z, extras(model, params), want)


def _finite_px(model: CameraModel, params: FloatArray, plane: Plane) -> tuple[FloatArray, IntArray | None]:
    """Return (2, n) px, NaN where not finite, and the points where it is not (None when there is none)."""
    fx, fy, cx, cy = scales_and_shifts(model, params)
    xy_px = np.empty((2, len(plane.x)))
    np.add(plane.x * fx, cx, out=xy_px[0])
    np.add(plane.y * fy, cy, out=xy_px[1])
    if math.isfinite(xy_px.sum()):
        return xy_px, None
    lost: IntArray = np.flatnonzero(~np.isfinite(xy_px).all(axis=0)).astype(np.int64)
    xy_px[:, lost] = np.nan
    return xy_px, lost


def _d_cam(model: CameraModel, params: FloatArray, plane: Plane) -> FloatArray:
    """Return (2, 3, n) d px / d point."""
    fx, fy, _, _ = scales_and_shifts(model, params)
    d_cam = np.empty((2, 3, len(plane.x)))
    for axis in range(3):
        np.multiply(plane.d_cam[axis], fx, out=d_cam[0, axis])
        np.multiply(plane.d_cam[3 + axis], fy, out=d_cam[1, axis])
    return d_cam


def _d_params(model: CameraModel, params: FloatArray, plane: Plane) -> FloatArray:
    """Return (p, 2, n) d px / d params."""
    fx, fy, _, _ = scales_and_shifts(model, params)
    d_params = np.zeros((model.num_params, 2, len(plane.x)))
    focals = (0, 1) if model.is_spherical else model.focal_idxs
    d_params[focals[0], 0] = plane.x
    d_params[focals[-1], 1] = plane.y
    for row, idx in enumerate(model.principal_point_idxs):
        d_params[idx, row] = 1.0
    for idx, (d_x, d_y) in zip(model.extra_idxs, plane.d_extra, strict=True):
        np.multiply(d_x, fx, out=d_params[idx, 0])
        np.multiply(d_y, fy, out=d_params[idx, 1])
    return d_params
