"""Which finite numbers can be calculated with? A focal length of 1e100 is finite, and its square is not.

Files are not trusted: one odd number must not end the audit of a model, and no stage after this one has to mind it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import CameraRecord, CameraTable

MAX_MAGNITUDE: Final = 1e12
"""Of a coordinate or a parameter, and of a derivative in units of the image's depth: squares, products stay finite."""
_MAX_DERIVATIVE: Final = 1e30  # in the model's unit, whatever that is
MAX_RESIDUAL_PX: Final = 1e9
_MIN_FOCAL_PX: Final = 1e-6
_FEW: Final = 1000


def is_sane(values: FloatArray) -> BoolArray:
    """Whether values are finite and at most 1e12 in magnitude; NaN is not."""
    return np.asarray(np.abs(values) <= MAX_MAGNITUDE)


def are_sane(values: FloatArray) -> bool:
    """Whether all are."""
    return bool(np.abs(values).max(initial=0.0) <= MAX_MAGNITUDE)


def are_differentiable(jacobian_cam: FloatArray, xyz_cam: FloatArray) -> bool:
    """Whether all derivatives are, as the largest of them and the largest distance tell; False where they do not."""
    largest = float(np.abs(jacobian_cam).max(initial=0.0))
    return largest <= _MAX_DERIVATIVE and largest * float(np.abs(xyz_cam).max(initial=0.0)) <= MAX_MAGNITUDE


def is_differentiable(jacobian_cam: FloatArray, xyz_cam: FloatArray) -> BoolArray:
    """Whether derivatives (2, 3, n) px per unit at points (n, 3) in the camera frame can be calculated with, (n,).

    They are compared in units of the median distance of the points, so that the unit of the model changes nothing.
    """
    if not len(xyz_cam):
        return np.ones(0, dtype=np.bool_)
    distance = _median(np.abs(xyz_cam).max(axis=1))
    largest = np.abs(jacobian_cam).max(axis=(0, 1))
    return np.asarray((largest * distance <= MAX_MAGNITUDE) & (largest <= _MAX_DERIVATIVE))


def _median(values: FloatArray) -> float:
    """Median of (n,), n > 0, NaN where one of them is; of few values np.median costs five times as much."""
    if len(values) > _FEW:
        return float(np.median(values))
    ascending = np.sort(values)  # NaN last
    middle = len(values) // 2
    median = ascending[middle] if len(values) % 2 else 0.5 * (ascending[middle - 1] + ascending[middle])
    return float(median) if not math.isnan(ascending[-1]) else math.nan


def is_usable(camera: CameraRecord) -> bool:
    """Whether anything can be projected with a camera: parameters sane, no focal length of (nearly) 0."""
    params = camera.params[None]
    return bool(are_usable(params, params[:, list(camera.model.focal_idxs)])[0])


def are_usable(params: FloatArray, focals_px: FloatArray) -> BoolArray:
    """Return the same (n,) of n cameras of one model: their parameters (n, p), and of these the focal lengths."""
    return np.asarray(is_sane(params).all(axis=1) & (np.abs(focals_px) >= _MIN_FOCAL_PX).all(axis=1))


def usable_cameras(cameras: CameraTable) -> BoolArray:
    """Return the same (C,) of all cameras of a model."""
    out = np.zeros(len(cameras), dtype=np.bool_)
    for model_id in distinct(cameras.model_id).tolist():
        rows = np.flatnonzero(cameras.model_id == model_id)
        params = params_of(cameras, rows)
        out[rows] = are_usable(params, params[:, list(BY_ID[model_id].focal_idxs)])
    return out


def params_of(cameras: CameraTable, rows: IntArray) -> FloatArray:
    """Return the parameters (n, p) of cameras of one model in these rows (n,), n > 0."""
    first, last = cameras.param_offsets[rows[0] : rows[0] + 2]
    return cameras.params[cameras.param_offsets[rows][:, None] + np.arange(last - first)]
