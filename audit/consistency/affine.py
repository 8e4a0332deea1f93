"""By which affine map do the observed points of an image follow from the projected ones? A robust fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

MEDIAN_LENGTH: Final = math.sqrt(2.0 * math.log(2.0))  # of |eps| / sigma, eps a normal 2-vector
_TUNING: Final = 2.385  # Cauchy weights of 95 % efficiency at the normal
KNEE: Final = _TUNING / MEDIAN_LENGTH
"""Of the weights, in medians of the lengths."""
_MAX_ROUNDS: Final = 20
_SMALLEST: Final = 1e-150  # length whose square is above 0
_SURELY_REGULAR: Final = 1e-8
_SINGULAR: Final = 1e-10  # eigenvalue of the unit Gram matrix below which the points lie on a line
_ROUND_TOLERANCE: Final = 1e-3  # of the noise: how far a fitted point may still move


@dataclass(frozen=True, slots=True, eq=False)
class AffineFit:
    """observed = linear @ projected + offset_px, pixel coordinates with the origin at the corner of the image.

    linear: (2, 2) A of method.md section 12.        offset_px: (2,) b.
    centre_px: (2,) mean of the projected points.    shift_px: (2,) observed - projected there, by the fit.
    sd_shift_px: of shift_px, per axis.              spread_px: (2,) sd of the projected x, y.
    noise_px: robust sd per axis of what the fit leaves.        rest_rms_px: RMS length of it, all points.
    """

    linear: FloatArray
    offset_px: FloatArray
    centre_px: FloatArray
    shift_px: FloatArray
    sd_shift_px: float
    spread_px: FloatArray
    noise_px: float
    rest_rms_px: float


def fit_affine(projected_px: FloatArray, residuals_px: FloatArray) -> AffineFit | None:
    """Fit observed = A projected + b by least squares with Cauchy weights, bounded rounds.

    Parameters
    ----------
    projected_px : (2, n)        residuals_px : (2, n) observed - projected

    Returns
    -------
    AffineFit
        None with fewer than four points, where they lie on a line, and where numbers are not finite.

    Notes
    -----
    Rounds start from the residuals as they are (A = 1, b = 0), so that a third of wrong links does not pull the fit
    away from the others; an exact relation is found from any weights.
    """
    n = projected_px.shape[1]
    with np.errstate(all="ignore"):
        mean, extent = projected_px.mean(axis=1), float(np.abs(projected_px).max(initial=0.0))
        unit_px = float(np.abs(residuals_px).max(initial=0.0)) or 1.0  # squares of shares of it do not overflow
        if n < 4 or not math.isfinite(extent) or not math.isfinite(unit_px) or extent == 0.0:
            return None
        design = np.concatenate([np.ones((1, n)), (projected_px - mean[:, None]) / extent])
        found = _weighted_rounds(design, residuals_px / unit_px)
        if found is None:
            return None
        coefficients, squares, median = found
        coefficients = coefficients * unit_px
        noise = median * unit_px / MEDIAN_LENGTH
        slope = coefficients[1:].T / extent
        offset = coefficients[0] - slope @ mean
        spread = np.sqrt((design[1:] ** 2).mean(axis=1)) * extent
        sd_shift = noise / math.sqrt(n)
        rest = math.sqrt(float(squares.mean())) * unit_px
    values = (slope, offset, spread, np.array([noise, rest]))
    if not all(np.isfinite(value).all() for value in values) or not spread.all():
        return None
    return AffineFit(np.eye(2) + slope, offset, mean, coefficients[0], sd_shift, spread, noise, rest)


def _weighted_rounds(design: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Coefficients (3, 2), and of what they leave the squared lengths (n,) and the median length; None: singular."""
    rest, squares = residuals, _squares(residuals)
    median = math.sqrt(median_of(squares))
    coefficients = np.zeros((3, 2))
    for _ in range(_MAX_ROUNDS):
        weighted = design * _weights(squares, median)
        gram = weighted @ design.T
        scale = 1.0 / np.sqrt(gram.diagonal())
        unit = gram * scale * scale[:, None]
        if _is_singular(unit):
            return None
        coefficients = np.linalg.solve(unit, scale[:, None] * (weighted @ residuals.T)) * scale[:, None]
        before, rest = rest, residuals - coefficients.T @ design
        squares = _squares(rest)
        median = math.sqrt(_median_near(squares, median * median))
        if np.abs(rest - before).max() <= _ROUND_TOLERANCE * median:
            break
    return coefficients, squares, median


def _squares(rest: FloatArray) -> FloatArray:
    """Squared lengths (n,) of (2, n)."""
    return np.asarray(rest[0] * rest[0] + rest[1] * rest[1])


def _is_singular(unit: FloatArray) -> bool:
    """Whether the smallest eigenvalue of a Gram matrix (3, 3) of unit columns is too small.

    It is at least 4/9 of the determinant: the other two add to less than 3.
    """
    (_, a, b), (_, _, c), _ = unit.tolist()
    if 1.0 - a * a - b * b - c * c + 2.0 * a * b * c > _SURELY_REGULAR:
        return False
    return not np.isfinite(unit).all() or bool(np.linalg.eigvalsh(unit)[0] < _SINGULAR)


def robust_weights(length_px: FloatArray, median_px: float) -> FloatArray:
    """Cauchy weights (n,) of lengths (n,): 1 for small ones, falling with the square beyond about 2.4 sd."""
    return np.asarray(1.0 / (1.0 + (length_px / _knee(median_px)) ** 2))


def _weights(squares: FloatArray, median: float) -> FloatArray:
    """The same of squared lengths."""
    return np.asarray(1.0 / (1.0 + squares / _knee(median) ** 2))


def _knee(median: float) -> float:
    return max(KNEE * median, _SMALLEST)


def median_of(values: FloatArray) -> float:
    """Upper median of (n,), NaN without any; at a quarter of the cost of `numpy.median` for short arrays."""
    middle = values.size // 2
    return float(np.partition(values, middle)[middle]) if values.size else math.nan


def _median_near(values: FloatArray, expected: float) -> float:
    """Return `median_of` (n,) without putting all in order where it is about what is expected."""
    least, most = 0.7 * expected, 1.2 * expected
    inside = values[(values >= least) & (values <= most)]
    rank = values.size // 2 - int(np.count_nonzero(values < least))
    return float(np.partition(inside, rank)[rank]) if 0 <= rank < inside.size else median_of(values)


def root_mean_square(length_px: FloatArray) -> float:
    """RMS of lengths (n,), NaN without any; squares do not overflow."""
    largest = float(length_px.max(initial=0.0))
    if length_px.size == 0 or not math.isfinite(largest) or largest == 0.0:
        return math.nan if length_px.size == 0 else largest
    return largest * math.sqrt(float(((length_px / largest) ** 2).mean()))
