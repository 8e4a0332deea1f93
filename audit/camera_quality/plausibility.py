"""Could this be a camera at all? Low residuals do not say so (method.md sections 6 and 7).

Measures of one camera alone; `audit.decision` judges them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.columns import Want
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.cameras.projection import extra_params, scale_and_shift
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.model import CameraRecord

_COARSE: Final = np.geomspace(1e-3, 1e2, 36)  # undistorted radii / distorted radius of the border point
_FINE: Final = np.arange(1, 49) / 48.0  # of the coarse radius at which something happened
_RIGHT_ANGLE: Final = math.pi / 2.0


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
    size = camera.width, camera.height
    if camera.model.is_spherical:
        return CameraPlausibility(math.nan, folds_over=False, principal_point_px=None, size_px=size)
    focal, _, cx, cy = scale_and_shift(camera.model, camera.params)
    longer = max(size)
    return CameraPlausibility(focal / longer if longer else math.nan, folds_over(camera), (cx, cy), size)


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
    model, functions = camera.model, functions_of(camera.model)
    if functions.distort is None:
        return False
    fx, fy, _, _ = scale_and_shift(model, camera.params)
    if fx == 0.0 or fy == 0.0 or camera.width <= 0 or camera.height <= 0:
        return False  # no distorted plane to look at; the focal length is out of range anyway
    goal = _border_points(camera)
    reach = np.hypot(goal[:, 0], goal[:, 1])
    goal, reach = goal[reach > 0.0], reach[reach > 0.0]
    extra = extra_params(model, camera.params)
    if functions.folds is not None:
        return functions.folds(extra, float(reach.max()) ** 2)
    direction = goal / reach[:, None]
    coarse = reach[:, None] * _COARSE
    if functions.is_fisheye:
        coarse = np.minimum(coarse, _RIGHT_ANGLE)
    turned, arrived = _states(functions.distort, extra, direction, coarse, reach)
    ended = _first(turned | arrived, coarse)
    fine = ended[:, None] * _FINE
    turned, arrived = _states(functions.distort, extra, direction, fine, reach)
    first_turn = np.where(turned.any(axis=1), turned.argmax(axis=1), _FINE.size)
    first_arrival = np.where(arrived.any(axis=1), arrived.argmax(axis=1), _FINE.size)
    return bool((first_turn < first_arrival).any())


def _border_points(camera: CameraRecord) -> FloatArray:
    """Return (16, 2): corners and quarter points of the image border on the distorted normalised plane."""
    fx, fy, cx, cy = scale_and_shift(camera.model, camera.params)
    step = np.arange(4) / 4.0
    x = np.concatenate([step, np.ones(4), 1.0 - step, np.zeros(4)])
    y = np.concatenate([np.zeros(4), step, np.ones(4), 1.0 - step])
    return np.column_stack([(x * camera.width - cx) / fx, (y * camera.height - cy) / fy])


def _first(event: BoolArray, radius: FloatArray) -> FloatArray:
    """Radius (d,) of the first event along each row of (d, k), the last radius where there is none."""
    column = np.where(event.any(axis=1), event.argmax(axis=1), event.shape[1] - 1)
    return np.asarray(radius[np.arange(len(radius)), column])


def _states(
    distort: WarpFunction, extra: list[float], direction: FloatArray, radius: FloatArray, reach: FloatArray
) -> BoolArray:
    """Return (2, d, k): where the derivative is not upright, and where the border's radius has been reached.

    direction : (d, 2) unit        radius : (d, k) undistorted        reach : (d,) distorted radius of the border point
    """
    u, v = ((radius * direction[:, axis, None]).ravel() for axis in range(2))
    with np.errstate(all="ignore"):
        x, y, xu, xv, yu, yv, _ = distort(u, v, extra, Want.D_POINT)
        upright = np.broadcast_to((xu * yv - xv * yu > 0.0) & (np.add(xu, yv) > 0.0), u.shape)
        arrived = (x * x + y * y).reshape(radius.shape) >= (reach * reach)[:, None]
    return np.stack([~upright.reshape(radius.shape), arrived])
