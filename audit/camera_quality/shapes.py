"""What depends on a camera alone, of many cameras of one model at once: arrays over (cameras, places in the image)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import project_columns, unproject
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

GRID: Final = 16
AT_ONCE: Final = 32
"""Cameras whose arrays are in memory together: 2 MB of columns."""


def in_stacks(cameras: Sequence[CameraRecord]) -> Iterator[list[int]]:
    """Yield the places of cameras of one model, up to `AT_ONCE` of them; FOV, which asks what omega is, one by one."""
    places: dict[str, list[int]] = {}
    for place, camera in enumerate(cameras):
        places.setdefault(camera.model.name, []).append(place)
    for name, alike in places.items():
        step = 1 if name == "FOV" else AT_ONCE
        yield from (alike[first : first + step] for first in range(0, len(alike), step))


def params_by_point(cameras: Sequence[CameraRecord], num_each: int) -> FloatArray:
    """Return (p, C num_each) parameters of C cameras of one model, each repeated; (p,) of one camera."""
    if len(cameras) == 1:
        return cameras[0].params
    return np.repeat(np.array([camera.params for camera in cameras]).T, num_each, axis=1)


def cell_centres_px(width: int, height: int, grid: int = GRID) -> FloatArray:
    """Return (grid, grid, 2) px: centres of grid x grid equal cells of the image; [row, column] as in an image."""
    return np.asarray(_grids_px(np.array([[width, height]]), grid)[0])


def _grids_px(size_px: FloatArray | IntArray, grid: int) -> FloatArray:
    """Return `cell_centres_px` of sizes (C, 2): (C, grid, grid, 2)."""
    share = (np.arange(grid) + 0.5) / grid
    out = np.empty((len(size_px), grid, grid, 2))
    out[..., 0] = (share * size_px[:, :1])[:, None, :]
    out[..., 1] = (share * size_px[:, 1:])[:, :, None]
    return out


def rays_of_grids(cameras: Sequence[CameraRecord], grid: int = GRID) -> FloatArray:
    """Return (C, grid * grid, 3) unit rays, camera frame, of the `cell_centres_px`; NaN where there is none.

    Parameters
    ----------
    cameras : C of one model that `in_stacks` put together
    """
    pixels = _grids_px(np.array([(camera.width, camera.height) for camera in cameras]), grid)
    params = params_by_point(cameras, grid * grid)
    return unproject(cameras[0].model, params, pixels.reshape(-1, 2)).reshape(len(cameras), grid * grid, 3)


def columns_of_grids(cameras: Sequence[CameraRecord], rays: FloatArray) -> FloatArray:
    """Return (C, q, 2, n) J_theta of the fitted parameters at depth 1 (distance 1 of spherical cameras), px per unit.

    Parameters
    ----------
    cameras : C of one model that `in_stacks` put together        rays : (C, n, 3) from `rays_of_grids`
    """
    model, (num_cameras, num_rays) = cameras[0].model, rays.shape[:2]
    with np.errstate(all="ignore"):
        xyz_cam = np.asfortranarray(at_depth(model, rays.reshape(-1, 3), 1.0))
        found = project_columns(model, params_by_point(cameras, num_rays), xyz_cam)
        d_params = np.empty((0, 2, len(xyz_cam))) if found.d_xy_d_params is None else found.d_xy_d_params
        columns = np.concatenate([pose_columns(found.d_xy_d_cam, xyz_cam), d_params[list(fitted_param_idxs(model))]])
    return np.ascontiguousarray(columns.reshape(-1, 2, num_cameras, num_rays).transpose(2, 0, 1, 3))


def at_depth(model: CameraModel, rays: FloatArray, depth: float) -> FloatArray:
    """Return the points on (n, 3) unit rays at Zc = depth; spherical models: at that distance."""
    return rays * depth if model.is_spherical else rays * (depth / rays[:, 2:])
