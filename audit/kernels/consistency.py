"""Observed = A projected + b of every image of a model, in one call; twin of `audit.consistency.affine`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.library import Double, Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

NOTHING, RMS, AFFINE = 0, 1, 2
"""What is wanted of an image."""
_NUM_VALUES: Final = 13


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """By image; values are undefined where ``done`` is false, all but the last also where no map was wanted.

    slope: (I, 2, 2) A - 1.    shift, centre, spread: (I, 2) px.    median, rest_rms, stored_rms: (I,) px, lengths of
    what the map leaves, and of the residuals.
    """

    done: BoolArray
    slope: FloatArray
    shift: FloatArray
    centre: FloatArray
    spread: FloatArray
    median: FloatArray
    rest_rms: FloatArray
    stored_rms: FloatArray


def fit_images(
    offsets: IntArray,
    residuals_px: FloatArray,
    rows: Int32Array,
    xy_px: FloatArray,
    *,
    wanted: IntArray,
    knee: float,
) -> Fitted | None:
    """Fit all images of a model; None for the numpy path.

    Parameters
    ----------
    offsets : (I + 1,) image i owns columns offsets[i]:offsets[i + 1]
    residuals_px : (2, n)    rows : (n,) their rows of xy_px (M, 2)
    wanted : (I,) `NOTHING`, `RMS` or `AFFINE`
    knee : of Cauchy's weights, in medians of the lengths

    Raises
    ------
    IndexError
        where an offset or a row does not fit its table.
    """
    function = kernel(
        "sfm_consistency", Size, Size, Ints, Size, Doubles, SmallInts, Doubles, Ints, Double, Doubles, Ints
    )
    if function is None:
        return None
    num_images, total = len(wanted), residuals_px.shape[1]
    lengths = np.diff(offsets)
    if (
        offsets.shape != (num_images + 1,)
        or rows.shape != (total,)
        or xy_px.shape[1:] != (2,)
        or offsets[0] != 0
        or offsets[-1] != total
        or (lengths < 0).any()
        or rows.min(initial=0) < 0
        or rows.max(initial=-1) >= len(xy_px)
    ):
        raise IndexError("an offset or a row points outside of its table")
    values, status = np.zeros((num_images, _NUM_VALUES)), np.ones(num_images, dtype=np.int64)
    arrays = (offsets, total, residuals_px, small_ints(rows, total), xy_px, wanted, knee, values, status)
    over_ranges(lambda start, stop: function(start, stop, *arrays), num_images, lengths)
    pairs = values[:, :10].reshape(num_images, 5, 2)
    return Fitted(status == 0, pairs[:, :2], pairs[:, 2], pairs[:, 3], pairs[:, 4], *values[:, 10:].T)
