"""Reprojection errors of many images, summed up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels.errors import error_summaries
from sfm_audit.audit.table.given import Column
from sfm_audit.loaders.arrays import FloatArray, IntArray

_COLUMNS: Final = ("rms_px", "mean_px", "median_px", "p95_px", "max_px")
_FEW: Final = 64
"""Images with so few inliers are sorted together with those that have as many."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSummary:
    """RMS, mean, median, 95th percentile and maximum of the reprojection errors of n images, (n, 5) px; NaN without."""

    px: FloatArray

    @property
    def longest_px(self) -> FloatArray:
        """(n,) the largest, 0 without inliers."""
        return np.where(np.isnan(self.px[:, 4]), 0.0, self.px[:, 4])

    @property
    def columns(self) -> dict[str, Column]:
        """Columns of the images table."""
        return dict(zip(_COLUMNS, self.px.T, strict=True))


def error_summary(residuals: ModelResiduals, image_idxs: range) -> ErrorSummary:
    """Sum up the reprojection errors of some images of a model."""
    offsets = residuals.offsets[image_idxs.start : image_idxs.stop + 1]
    counts = np.diff(offsets)
    out = np.full((len(counts), len(_COLUMNS)), math.nan)
    left = (counts > 0) & ~error_summaries(residuals.residuals_px, offsets, out)
    if left.any():
        out[left] = _summed_up(residuals.residuals_px, offsets[:-1][left], counts[left])
    return ErrorSummary(out)


def _summed_up(residuals_px: FloatArray, first: IntArray, counts: IntArray) -> FloatArray:
    """Sum up (B, 5) images with inliers, whose columns begin with the first."""
    ends = np.cumsum(counts)
    starts = ends - counts
    begin, end = int(first[0]), int(first[-1] + counts[-1])
    if end - begin == ends[-1]:
        x, y = residuals_px[:, begin:end]
    else:  # they do not follow each other
        x, y = residuals_px[:, np.repeat(first - starts, counts) + np.arange(ends[-1])]
    sq = x * x + y * y
    stacks = [_stack(starts, counts, size) for size in np.unique(counts[counts <= _FEW]).tolist()]
    many = [(row, slice(starts[row], starts[row] + counts[row])) for row in np.flatnonzero(counts > _FEW).tolist()]
    error = sq.copy()
    for _, columns in stacks:
        error[columns] = np.sort(sq[columns], axis=1)
    for _, own in many:
        error[own].sort()
    np.sqrt(error, out=error)
    out = np.full((len(counts), len(_COLUMNS)), math.nan)
    for rows, columns in stacks:
        out[rows, 0], out[rows, 1] = np.sqrt(sq[columns].mean(axis=1)), error[columns].mean(axis=1)
    for row, own in many:
        out[row, 0] = math.sqrt(np.add.reduce(sq[own]) / counts[row])
        out[row, 1] = np.add.reduce(error[own]) / counts[row]
    for place, q in ((2, 0.5), (3, 0.95), (4, 1.0)):
        out[:, place] = _quantiles(error, starts, counts, q)
    return out


def _stack(starts: IntArray, counts: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """Return the images with so many inliers, and the columns of each, a row of (B, size)."""
    rows = np.flatnonzero(counts == size)
    return rows, starts[rows][:, None] + np.arange(size)


def _quantiles(ascending: FloatArray, starts: IntArray, counts: IntArray, q: float) -> FloatArray:
    """Linear interpolation between order statistics, as numpy.quantile's default, of parts of a column."""
    position = q * (counts - 1)
    low = position.astype(np.int64)
    below, above = ascending[starts + low], ascending[starts + np.minimum(low + 1, counts - 1)]
    return np.asarray(below + (position - low) * (above - below))
