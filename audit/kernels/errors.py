"""Reprojection errors of the images of a model, summed up: errors.c."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.kernels.library import Bytes, Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_NUM_COLUMNS: Final = 5


def error_summaries(residuals_px: FloatArray, offsets: IntArray, out: FloatArray) -> BoolArray:
    """Write RMS, mean, median, 95th percentile and maximum of images' errors into ``out`` (B, 5); return where (B,).

    Parameters
    ----------
    residuals_px : (2, n)        offsets : (B + 1,) ascending, columns of each image
    """
    run = kernel("error_summaries", Size, Size, Ints, Doubles, Doubles, Bytes)
    num_images, n = len(offsets) - 1, residuals_px.shape[1]
    status = np.ones(num_images, dtype=np.uint8)
    if num_images < 0 or offsets[0] < 0 or offsets[-1] > n or np.any(np.diff(offsets) < 0):
        raise IndexError(f"images beyond the {n} columns there are")
    if out.shape != (num_images, _NUM_COLUMNS):
        raise ValueError(f"room for {out.shape} numbers, not for {(num_images, _NUM_COLUMNS)}")
    if run is not None:
        run(num_images, n, np.ascontiguousarray(offsets), np.ascontiguousarray(residuals_px), out, status)
    return np.asarray(status == 0)
