"""How wrong is a measurement that is taken with this camera, where in the image? (the paper's conclusion; method.md 6).

Conditional on the points, like the covariance it is made of: a lower bound in a reconstruction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.identifiability import POSE_NAMES, ParameterCovariance, fitted_names
from sfm_audit.audit.cameras import unproject
from sfm_audit.audit.cameras.columns import EPSILON
from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.misfit.nuisance import nuisance_columns
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import CameraRecord

GRID: Final = 16
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


def cell_centres_px(width: int, height: int, grid: int = GRID) -> FloatArray:
    """Return (grid, grid, 2) px: centres of grid x grid equal cells of the image."""
    share = (np.arange(grid) + 0.5) / grid
    return np.stack(np.meshgrid(share * width, share * height), axis=-1)


def grid_rays(camera: CameraRecord, grid: int = GRID) -> FloatArray:
    """Return (grid * grid, 3) unit rays, camera frame, of the `cell_centres_px`; NaN where there is none.

    They depend on the camera alone: compute them once where images share a camera.
    """
    pixels = cell_centres_px(camera.width, camera.height, grid).reshape(-1, 2)
    return unproject(camera.model, camera.params, pixels)


def grid_columns(camera: CameraRecord, grid: int = GRID, *, rays: FloatArray | None = None) -> FloatArray:
    """Return (q, 2, grid * grid) J_theta of `fitted_names` at depth 1 (distance 1 of spherical cameras), px per unit.

    At depth d the columns of the translation are these over d, all others are these: they depend on the camera alone.

    Parameters
    ----------
    rays : `grid_rays` of this camera and grid, where they are at hand
    """
    rays = grid_rays(camera, grid) if rays is None else rays
    with np.errstate(invalid="ignore", over="ignore"):
        return nuisance_columns(camera.model, project_image(camera, _at_depth(camera, rays, 1.0)))


def _at_depth(camera: CameraRecord, rays: FloatArray, depth: float) -> FloatArray:
    return rays * depth if camera.model.is_spherical else rays * (depth / rays[:, 2:])


def median_depth(camera: CameraRecord, xyz_cam: FloatArray) -> float:
    """Median Zc of (n, 3) points in the camera frame, model units; spherical cameras: median distance; NaN if none."""
    if not len(xyz_cam):
        return math.nan
    return float(np.median(depths(camera, xyz_cam)))


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
    error = measurement_error_px(columns, fitted_names(camera.model), seen, sigma_px)
    error.sort()  # NaN last
    num = int(np.searchsorted(error, np.inf))
    return 0.5 * float(error[(num - 1) // 2] + error[num // 2]) if num else math.nan


def _seen_from_one(camera: CameraRecord, parameters: ParameterCovariance, depth: float) -> ParameterCovariance:
    """Return the covariance in the unit of length that makes ``depth`` 1; NaN where nothing projects from there."""
    nearest = 0.0 if camera.model.is_spherical else EPSILON
    inverse = 1.0 / depth if nearest <= depth < math.inf and depth else math.nan
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
    variance = np.einsum("cm,cm->m", parameters.covariance @ by_pixel, by_pixel).reshape(2, -1).sum(axis=0)
    return np.asarray(np.sqrt(variance + 2.0 * sigma_px**2))
