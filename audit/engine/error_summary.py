"""Reprojection errors of many images, summed up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.table.arrow import Column
from sfm_audit.loaders.arrays import FloatArray

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
    first, last = int(offsets[0]), int(offsets[-1])
    x, y = residuals.residuals_px[:, first:last]
    sq = x * x + y * y
    starts, counts = offsets[:-1] - first, np.diff(offsets)
    out = np.full((len(counts), len(_COLUMNS)), math.nan)
    for size in np.unique(counts[(counts > 0) & (counts <= _FEW)]).tolist():
        rows = np.flatnonzero(counts == size)
        out[rows] = _summaries(sq[starts[rows][:, None] + np.arange(size)])
    for row in np.flatnonzero(counts > _FEW).tolist():
        out[row] = _summaries(sq[starts[row] : starts[row] + counts[row]][None])[0]
    return ErrorSummary(out)


def _summaries(sq: FloatArray) -> FloatArray:
    """Return the five numbers of each row of squares (B, m)."""
    error = np.sqrt(np.sort(sq, axis=1))
    return np.stack(
        [np.sqrt(sq.mean(axis=1)), error.mean(axis=1), _quantile(error, 0.5), _quantile(error, 0.95), error[:, -1]],
        axis=1,
    )


def _quantile(ascending: FloatArray, q: float) -> FloatArray:
    """Linear interpolation between order statistics, as numpy.quantile's default, of each row."""
    position = q * (ascending.shape[1] - 1)
    low = int(position)
    high = min(low + 1, ascending.shape[1] - 1)
    return np.asarray(ascending[:, low] + (position - low) * (ascending[:, high] - ascending[:, low]))
