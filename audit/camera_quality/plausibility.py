"""Could this be a camera at all? Low residuals do not say so (method.md sections 6 and 7).

Measures of one camera alone; `audit.decision` judges them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.shapes import params_by_point
from sfm_audit.audit.cameras.columns import Want
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.cameras.projection import extras, scale_and_shift, scales_and_shifts
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

_COARSE: Final = np.geomspace(1e-3, 1e2, 36)  # undistorted radii / distorted radius of the border point
_FINE: Final = np.arange(1, 49) / 48.0  # of the coarse radius at which something happened
_RIGHT_ANGLE: Final = math.pi / 2.0
_STEP: Final = np.arange(4) / 4.0
_BORDER_X: Final = np.concatenate([_STEP, np.ones(4), 1.0 - _STEP, np.zeros(4)])
_BORDER_Y: Final = np.concatenate([np.zeros(4), _STEP, np.ones(4), 1.0 - _STEP])
"""Corners and quarter points of the image's border, as shares of its width and height."""


@dataclass(frozen=True, slots=True)
class CameraPlausibility:
    """Measures of one camera; None and NaN where it has no focal length and no principal point (panoramas).

    focal_over_size: first focal length / max(width, height).    folds_over: the distortion folds inside the image.
    principal_point_px, size_px: where it is, and width and height.
    """

    focal_over_size: float
    folds_over: bool
    principal_point_px: tuple[float, float] | None
    size_px: tuple[int, int]


def camera_plausibility(camera: CameraRecord) -> CameraPlausibility:
    """Measure a camera whose parameters are finite; it depends on nothing else, so once per camera is enough."""
    return camera_plausibilities([camera])[0]


def camera_plausibilities(cameras: Sequence[CameraRecord]) -> list[CameraPlausibility]:
    """Return `camera_plausibility` of cameras of one model that `shapes.in_stacks` put together."""
    folds = stack_folds(cameras)
    return [_plausibility(camera, folds=fold) for camera, fold in zip(cameras, folds.tolist(), strict=True)]


def _plausibility(camera: CameraRecord, *, folds: bool) -> CameraPlausibility:
    size = camera.width, camera.height
    if camera.model.is_spherical:
        return CameraPlausibility(math.nan, folds_over=False, principal_point_px=None, size_px=size)
    focal, _, cx, cy = scale_and_shift(camera.model, camera.params)
    longer = max(size)
    return CameraPlausibility(focal / longer if longer else math.nan, folds, (cx, cy), size)


def folds_over(camera: CameraRecord) -> bool:
    """Whether the distortion folds inside the image: two directions are mapped to one pixel, or to none.

    Parameters
    ----------
    camera : parameters finite, focal lengths not 0

    Notes
    -----
    Rays of undistorted points u leave the principal point towards the corners and twelve more points of the border.
    On each, the derivative D = d (x, y) / d u has to stay upright (det D > 0, trace D > 0, the condition under which
    `audit.cameras.unproject` accepts a solution) until the distorted radius has reached that of the border point. If D
    turns first, the border point has no preimage on the principal point's side of the fold, and some pixel has two.
    A first, geometric grid of radii finds the scale, a second, linear one decides; a fold that a lens reaches within
    0.1 % of the border's radius may be told either way.

    No fold: a ray that never reaches its border point and stays upright, such as the image circle of a fisheye lens
    (theta < 90 degrees) or of FOV, EUCM and the division models with k < 0. A division model with k > 0 ends where
    k r_d^2 = 1, where its derivative is infinite; beyond, COLMAP's way back folds, and that counts.
    """
    return bool(stack_folds([camera])[0])


def stack_folds(cameras: Sequence[CameraRecord]) -> BoolArray:
    """Return `folds_over` of C cameras of one model that `shapes.in_stacks` put together."""
    model, functions = cameras[0].model, functions_of(cameras[0].model)
    if functions.distort is None:
        return np.zeros(len(cameras), dtype=np.bool_)
    params = np.array([camera.params for camera in cameras]).T
    fx, fy, cx, cy = scales_and_shifts(model, params)
    width, height = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64).T
    # without a distorted plane to look at nothing folds; the focal length is out of range anyway
    seen = (fx != 0.0) & (fy != 0.0) & (width > 0) & (height > 0)
    with np.errstate(all="ignore"):
        goal_x = (_BORDER_X * width[:, None] - np.reshape(cx, (-1, 1))) / np.reshape(fx, (-1, 1))
        goal_y = (_BORDER_Y * height[:, None] - np.reshape(cy, (-1, 1))) / np.reshape(fy, (-1, 1))
        reach = np.hypot(goal_x, goal_y)
    if functions.folds is not None:
        largest, extra = reach.max(axis=1), params[list(model.extra_idxs)].T.tolist()
        ends = [functions.folds(own, float(far) ** 2) for own, far in zip(extra, largest, strict=True)]
        return np.asarray(seen & ends)
    with np.errstate(all="ignore"):
        rays = _BorderRays(functions.distort, params_by_point(cameras, _BORDER_X.size), model, reach.ravel())
        direction = np.stack([goal_x.ravel(), goal_y.ravel()]) / reach.ravel()
        turns_first = rays.turn_first(direction, is_fisheye=functions.is_fisheye)
    return np.asarray(seen & (turns_first.reshape(reach.shape) & (reach > 0.0)).any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _BorderRays:
    """Rays of undistorted points towards points of borders.

    params: (p, d) of the camera of each, or (p,).    reach: (d,) distorted radius of the border point.
    """

    distort: WarpFunction
    params: FloatArray
    model: CameraModel
    reach: FloatArray

    def turn_first(self, direction: FloatArray, *, is_fisheye: bool) -> BoolArray:
        """Whether the derivative is not upright on the way (d,), in unit directions (2, d), before reach is reached."""
        coarse = self.reach[:, None] * _COARSE
        if is_fisheye:
            coarse = np.minimum(coarse, _RIGHT_ANGLE)
        ended = _first(np.logical_or(*self._states(direction, coarse)), coarse)
        turned, arrived = self._states(direction, ended[:, None] * _FINE)
        first_turn = np.where(turned.any(axis=1), turned.argmax(axis=1), _FINE.size)
        first_arrival = np.where(arrived.any(axis=1), arrived.argmax(axis=1), _FINE.size)
        return np.asarray(first_turn < first_arrival)

    def _states(self, direction: FloatArray, radius: FloatArray) -> tuple[BoolArray, BoolArray]:
        """Return (d, k) each, at undistorted radii (d, k): where it is not upright, and where reach is reached."""
        u, v = ((radius * along[:, None]).ravel() for along in direction)
        by_place = self.params if self.params.ndim == 1 else np.repeat(self.params, radius.shape[1], axis=1)
        x, y, xu, xv, yu, yv, _ = self.distort(u, v, extras(self.model, by_place), Want.D_POINT)
        upright = np.broadcast_to((xu * yv - xv * yu > 0.0) & (np.add(xu, yv) > 0.0), u.shape)
        arrived = (x * x + y * y).reshape(radius.shape) >= (self.reach * self.reach)[:, None]
        return ~upright.reshape(radius.shape), arrived


def _first(event: BoolArray, radius: FloatArray) -> FloatArray:
    """Radius (d,) of the first event along each row of (d, k), the last radius where there is none."""
    column = np.where(event.any(axis=1), event.argmax(axis=1), event.shape[1] - 1)
    return np.asarray(radius[np.arange(len(radius)), column])
