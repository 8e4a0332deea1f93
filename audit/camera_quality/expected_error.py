"""How wrong is a measurement that is taken with this camera, where in the image? (the paper's conclusion; method.md 6).

Conditional on the points, like the covariance it is made of: a lower bound in a reconstruction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.identifiability import POSE_NAMES, ParameterCovariance, fitted_names
from sfm_audit.audit.camera_quality.shapes import GRID, cell_centres_px, columns_of_grids, rays_of_grids
from sfm_audit.audit.cameras.columns import EPSILON
from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

_TRANSLATION: Final = frozenset(POSE_NAMES[3:])


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedErrorMap:
    """Expected measurement error over an image.

    xy_px: (grid, grid, 2) px, centres of equal cells; [row, column] as in an image.
    error_px: (grid, grid) px, RMS length of the error of one measurement; NaN where no ray reaches the pixel.
    """

    xy_px: FloatArray
    error_px: FloatArray

    @property
    def median_px(self) -> float:
        """`expected_error_px`: the median over the pixels that see something; NaN without any."""
        finite = self.error_px[np.isfinite(self.error_px)]
        return float(np.median(finite)) if finite.size else math.nan


def grid_rays(camera: CameraRecord, grid: int = GRID) -> FloatArray:
    """Return (grid * grid, 3) unit rays, camera frame, of the `cell_centres_px`; NaN where there is none.

    They depend on the camera alone: compute them once where images share a camera.
    """
    return np.asarray(rays_of_grids([camera], grid)[0])


def grid_columns(camera: CameraRecord, grid: int = GRID, *, rays: FloatArray | None = None) -> FloatArray:
    """Return (q, 2, grid * grid) J_theta of `fitted_names` at depth 1 (distance 1 of spherical cameras), px per unit.

    At depth d the columns of the translation are these over d, all others are these: they depend on the camera alone.

    Parameters
    ----------
    rays : `grid_rays` of this camera and grid, where they are at hand
    """
    rays = grid_rays(camera, grid) if rays is None else rays
    return np.asarray(columns_of_grids([camera], rays[None])[0])


def median_depth(camera: CameraRecord, xyz_cam: FloatArray) -> float:
    """Median Zc of (n, 3) points in the camera frame, model units; spherical cameras: median distance; NaN if none."""
    if not len(xyz_cam):
        return math.nan
    return float(np.median(depths(camera, xyz_cam)))


def medians_of(values: FloatArray, offsets: IntArray) -> FloatArray:
    """Return medians (B,) of values (n,), image b owning offsets[b]:offsets[b + 1]; NaN without any."""
    num = np.diff(offsets)
    out = np.full(len(num), np.nan)
    for size in distinct(num[num > 0]).tolist():  # of many small images few are different
        alike = np.flatnonzero(num == size)
        out[alike] = np.median(values[offsets[alike][:, None] + np.arange(size)], axis=1)
    return out


def depths(camera: CameraRecord, xyz_cam: FloatArray) -> FloatArray:
    """Zc (n,) of points (n, 3) in the camera frame, model units; spherical cameras: their distance."""
    return np.asarray(np.sqrt((xyz_cam**2).sum(axis=1)) if camera.model.is_spherical else xyz_cam[:, 2])


def expected_error_map(
    camera: CameraRecord,
    parameters: ParameterCovariance,
    sigma_px: float,
    depth: float,
    *,
    grid: int = GRID,
    columns: FloatArray | None = None,
) -> ExpectedErrorMap:
    """Return the expected error of one measurement at every cell centre of the image.

    Parameters
    ----------
    camera : the image's camera
    parameters : covariance of the parameters in `audit.camera_quality.identifiability.fitted_names`
    sigma_px : noise of a measurement per axis, px; sigma_constant_px, the sigma behind the covariance
    depth : model units, see `median_depth`
    grid : cells per side
    columns : `grid_columns` of this camera and grid, where they are at hand

    Raises
    ------
    ValueError
        when the covariance holds parameters that this camera does not have.

    Notes
    -----
    sqrt(tr(J_theta C J_theta^T) + 2 sigma_d^2), with J_theta the Jacobian in the fitted parameters at the point on
    the pixel's ray at ``depth`` (method.md section 6). The number depends on the depth only through the translation.
    sigma_d is taken as sigma_constant_px: under the noise model ``track`` the sigma_d_px of (1) is what is left when
    the tracks have explained their share, often 0, and no measurement error.

    A singular or unknown covariance gives NaN everywhere, and so does a depth at which nothing projects.
    """
    columns = grid_columns(camera, grid) if columns is None else columns
    pixels = cell_centres_px(camera.width, camera.height, grid)
    names = fitted_names(camera.model)
    error = measurement_error_px(columns, names, _seen_from_one(camera, parameters, depth), sigma_px)
    return ExpectedErrorMap(pixels, error.reshape(grid, grid))


def expected_error_px(
    camera: CameraRecord, parameters: ParameterCovariance, sigma_px: float, depth: float, columns: FloatArray
) -> float:
    """Return the median of the map alone; arguments as of `expected_error_map`."""
    seen = _seen_from_one(camera, parameters, depth)
    return float(_medians(measurement_error_px(columns, fitted_names(camera.model), seen, sigma_px)[None])[0])


def stack_errors_px(
    model: CameraModel, columns: FloatArray, covariance: FloatArray, sigma_px: FloatArray, depth: FloatArray
) -> FloatArray:
    """Return `expected_error_px` of B images whose cameras have one model, (B,).

    Parameters
    ----------
    columns : (B, q, 2, n) `grid_columns` of each image's camera, (1, q, 2, n) where they share one
    covariance : (B, q, q) of all parameters in `fitted_names`        sigma_px, depth : (B,) as of `expected_error_map`
    """
    moves = np.isin(fitted_names(model), list(_TRANSLATION))
    unit = np.where(moves, _inverse_depth(model, depth)[:, None], 1.0)
    seen = covariance * unit[:, None] * unit[:, :, None]
    by_pixel = columns.reshape(*columns.shape[:2], -1)
    product = seen @ by_pixel
    product *= by_pixel
    variance = product.sum(axis=1).reshape(len(seen), 2, -1).sum(axis=1)
    return _medians(np.sqrt(variance + 2.0 * sigma_px[:, None] ** 2))


def _medians(error: FloatArray) -> FloatArray:
    """Medians (B,) of the finite ones of (B, n), n > 0; NaN without any."""
    error = np.sort(error, axis=1)  # NaN last
    num = np.count_nonzero(error < np.inf, axis=1)
    row = np.arange(len(error))
    middle = 0.5 * (error[row, np.maximum(num - 1, 0) // 2] + error[row, np.minimum(num // 2, error.shape[1] - 1)])
    return np.where(num > 0, middle, np.nan)


def _inverse_depth(model: CameraModel, depth: FloatArray) -> FloatArray:
    """1 / depth; NaN where nothing projects from there."""
    nearest = 0.0 if model.is_spherical else EPSILON
    with np.errstate(divide="ignore"):
        return np.where((nearest <= depth) & (depth < np.inf) & (depth != 0.0), 1.0 / depth, np.nan)


def _seen_from_one(camera: CameraRecord, parameters: ParameterCovariance, depth: float) -> ParameterCovariance:
    """Return the covariance in the unit of length that makes ``depth`` 1; NaN where nothing projects from there."""
    inverse = float(_inverse_depth(camera.model, np.array([depth]))[0])
    unit = np.array([inverse if name in _TRANSLATION else 1.0 for name in parameters.names])
    return replace(parameters, covariance=parameters.covariance * unit * unit[:, None])


def measurement_error_px(
    columns: FloatArray, names: tuple[str, ...], parameters: ParameterCovariance, sigma_px: float
) -> FloatArray:
    """Return (n,) px: sqrt(tr(J_theta C J_theta^T) + 2 sigma^2) at n points.

    Parameters
    ----------
    columns : (q, 2, n) J_theta, px per unit, of the parameters ``names`` (q,)
    parameters : their covariance; of those without effect on the observations it knows nothing
    sigma_px : noise of a measurement per axis

    Raises
    ------
    ValueError
        when the covariance holds parameters that are not among the names.
    """
    if len(parameters.names) < len(names):
        columns = columns[[names.index(name) for name in parameters.names]]
    by_pixel = columns.reshape(len(columns), -1)
    product = parameters.covariance @ by_pixel
    product *= by_pixel
    variance = product.sum(axis=0).reshape(2, -1).sum(axis=0)
    return np.asarray(np.sqrt(variance + 2.0 * sigma_px**2))
