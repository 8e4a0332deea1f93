"""Noise of the images of a model: noise.c."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.kernels.library import Bytes, Double, Doubles, Ints, Size, SmallInts, kernel, kernels_in_use
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray, UInt8Array

DONE: Final = 0
FIT_IS_LEFT: Final = 3
"""Status of an image whose z and factor are there, and whose variances numpy is to fit."""
_COLUMNS: Final = ("factor_sq", "detector_px2", "structure", "converged", "median_scale_px")
_NUM_CELLS: Final = 193


def available() -> bool:
    """Whether the functions of this module can be called."""
    return kernels_in_use()


def constant_variances(residuals_px: FloatArray, offsets: IntArray, kappa: float) -> FloatArray:
    """Return `audit.noise.fits.fit_constant_variance` of images (I,); NaN where numpy is to be asked.

    Parameters
    ----------
    residuals_px : (2, n)        offsets : (I + 1,) ascending, columns of each image        kappa : CONSISTENCY
    """
    run = kernel("constant_noises", Size, Size, Ints, Doubles, Double, Doubles, Bytes)
    num_images, n = len(offsets) - 1, residuals_px.shape[1]
    theta, status = np.full(num_images, np.nan), np.ones(num_images, dtype=np.uint8)
    _check(offsets, n)
    if run is not None:
        run(num_images, n, np.ascontiguousarray(offsets), np.ascontiguousarray(residuals_px), kappa, theta, status)
    theta[status != DONE] = np.nan
    return theta


@dataclass(frozen=True, slots=True, eq=False)
class TrackNoises:
    """The noise of images under the noise model ``track``.

    status: (I,) DONE, FIT_IS_LEFT, or anything else where numpy is to be asked.    z: (V, 2) of all verified
    observations, one image after the other.    outside: (V, 2) where z holds t, which numpy is to transform.
    factor_sq, detector_px2, structure, converged, median_scale_px: (I,) see `audit.noise.standardise.ImageNoise`;
    the last before the factor.
    """

    status: UInt8Array
    z: FloatArray
    outside: BoolArray
    factor_sq: FloatArray
    detector_px2: FloatArray
    structure: FloatArray
    converged: FloatArray
    median_scale_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """What the kernel needs of a model: columns (n,) of `audit.noise.tracks.TrackStatistics`, the prior, tables.

    tables: coefficients (v * 193, 4) of `audit.noise.predictive.StudentToNormal` for x, and for y given x.
    dof: (v,) ascending, their degrees of freedom without nu0.
    """

    whitened_px: FloatArray
    verified: BoolArray
    other_sq_px2: FloatArray
    other_dof: Int32Array
    nu0: float
    s0_px: float
    dof: IntArray
    tables: tuple[FloatArray, FloatArray]

    def noises(self, offsets: IntArray, verified_offsets: IntArray, kappa: float) -> TrackNoises:
        """Return the noise of images (I,) whose columns and verified observations begin at these offsets (I + 1,)."""
        num_images, n = len(offsets) - 1, self.verified.size
        z = np.empty((int(verified_offsets[-1] - verified_offsets[0]), 2))
        outside, out = np.zeros(z.shape, dtype=np.uint8), np.full((num_images, len(_COLUMNS)), np.nan)
        status = np.ones(num_images, dtype=np.uint8)
        _check(offsets, n)
        row_of = np.full(int(self.dof[-1]) + 1 if self.dof.size else 1, -1, dtype=np.int32)
        row_of[self.dof] = np.arange(self.dof.size)
        columns = slice(int(offsets[0]), int(offsets[-1]))
        used = self.other_dof[columns][self.verified[columns]]
        if used.size != len(z) or np.any(used > row_of.size - 1) or np.any(row_of[used] < 0):
            raise IndexError("degrees of freedom that are not in the tables")
        if any(table.shape != (self.dof.size * _NUM_CELLS, 4) for table in self.tables):
            raise ValueError("tables are not of the size that the kernel reads")
        model = (Ints, Ints, Doubles, Bytes, Doubles, SmallInts, Doubles, Double, SmallInts, Doubles, Doubles)
        run = kernel("track_noises", Size, Size, *model, Doubles, Bytes, Doubles, Bytes)
        if run is not None:
            given = (self.whitened_px, self.verified.view(np.uint8), self.other_sq_px2, self.other_dof)
            prior = np.array([self.nu0, self.s0_px])
            rows = (np.ascontiguousarray(offsets), np.ascontiguousarray(verified_offsets))
            run(num_images, n, *rows, *given, prior, kappa, row_of, *self.tables, z, outside, out, status)
        return TrackNoises(status, z, outside.view(np.bool_), *out.T)


def _check(offsets: IntArray, n: int) -> None:
    """Offsets of images within n columns, or an error."""
    if not len(offsets) or offsets[0] < 0 or offsets[-1] > n or np.any(np.diff(offsets) < 0):
        raise IndexError(f"images beyond the {n} columns there are")
