"""Which finite numbers can be calculated with? A focal length of 1e100 is finite, and its square is not.

Files are not trusted: one odd number must not end the audit of a model, and no stage after this one has to mind it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.model import CameraRecord

MAX_MAGNITUDE: Final = 1e12
"""Of a coordinate, a parameter or a derivative: squares, and products of several, stay finite."""
MAX_RESIDUAL_PX: Final = 1e9
_MIN_FOCAL_PX: Final = 1e-6


def is_sane(values: FloatArray) -> BoolArray:
    """Whether values are finite and at most 1e12 in magnitude; NaN is not."""
    return np.asarray(np.abs(values) <= MAX_MAGNITUDE)


def is_usable(camera: CameraRecord) -> bool:
    """Whether anything can be projected with a camera: parameters sane, no focal length of (nearly) 0."""
    focals = camera.params[list(camera.model.focal_idxs)]
    return bool(is_sane(camera.params).all() and (np.abs(focals) >= _MIN_FOCAL_PX).all())
