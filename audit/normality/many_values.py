"""Statistics of samples of many values: one by one where values cost, all together where calls do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from scipy import special

from sfm_audit.audit.normality.shapiro import MAX_VALUES
from sfm_audit.loaders.arrays import FloatArray, IntArray

MANY_POINTS: Final = 128
"""Samples of fewer points are looked at in stacks, by `audit.normality.statistics`."""
_EVERY: Final = 8
_ROUNDING: Final = 1e-12
_KEYS: Final = 65535.0
_WIDEST: Final = 6.0

Cdf = Callable[[FloatArray, IntArray], FloatArray]
"""Distribution function of values (m,), which may differ between their samples (m,)."""


def statistics_of_many(samples: Sequence[FloatArray]) -> FloatArray:
    """Return the statistics (B, c), see `audit.kernels.normality.COLUMNS`, of usual samples (n, 2) of any sizes.

    Notes
    -----
    Each sum is over one sample, so that none depends on the others. Kolmogorov's distances are exact and yet ask few
    distribution functions, see `largest_distances`.
    """
    num_points: IntArray = np.array([len(z) for z in samples], dtype=np.int64)
    offsets: IntArray = np.concatenate([[0], np.cumsum(num_points)])
    ascending, half_squares = np.empty(2 * int(offsets[-1])), np.empty(int(offsets[-1]))
    moments, order = np.empty((len(samples), 5)), np.empty((len(samples), 7))
    for k, (z, start, stop) in enumerate(zip(samples, offsets.tolist(), offsets[1:].tolist(), strict=False)):
        values = np.ascontiguousarray(z).reshape(-1)
        moments[k, :4] = _moments(values)
        square = values * values
        half = square[::2] + square[1::2]
        half *= 0.5
        moments[k, 4] = np.add.reduce(half) / half.size
        ascending[2 * start : 2 * stop] = own = in_order(values, -_WIDEST, _WIDEST)
        half_squares[start:stop] = in_order(half, 0.0, 0.5 * _WIDEST**2)
        step = math.ceil(values.size / MAX_VALUES)
        order[k] = of_order(own if step == 1 else np.sort(z[::step].reshape(-1)))
    mean, m2, m3, m4, mean_half = moments.T
    sd = np.sqrt(m2 * (2 * num_points) / (2 * num_points - 1))
    columns = [
        largest_distances(ascending, 2 * offsets, lambda x, _: np.asarray(special.ndtr(x))),
        largest_distances(ascending, 2 * offsets, lambda x, k: np.asarray(special.ndtr((x - mean[k]) / sd[k]))),
        largest_distances(half_squares, offsets, lambda x, k: -np.expm1(x / -mean_half[k])),
        largest_distances(half_squares, offsets, lambda x, _: -np.expm1(-x)),
        *(m2, m3, m4),
        *order.T,
    ]
    return np.stack(columns, axis=1)


def _moments(values: FloatArray) -> tuple[float, float, float, float]:
    """Mean and central moments of values (N,)."""
    num = values.size
    mean = float(np.add.reduce(values)) / num
    deviation = values - mean
    square = deviation * deviation
    m2 = float(np.add.reduce(square)) / num
    deviation *= square
    square *= square
    return mean, m2, float(np.add.reduce(deviation)) / num, float(np.add.reduce(square)) / num


def in_order(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return values (N,) in ascending order, of which most lie between ``low`` and ``high``.

    Sorted by 16 bits first, which needs no comparisons, then what is nearly in order: half the time of numpy.sort.
    """
    key = np.clip(values, low, high)
    key -= low
    key *= _KEYS / (high - low)
    ascending = values.take(np.argsort(key.astype(np.uint16), kind="stable"))
    ascending.sort(kind="stable")
    return ascending


def largest_distances(ascending: FloatArray, offsets: IntArray, cdf: Cdf) -> FloatArray:
    """Kolmogorov's D (B,) of samples, each ascending, which begin at these offsets (B + 1,).

    Notes
    -----
    Both distribution functions rise. Between two values where both are known, D is at most what is between the lower
    one of the one and the upper one of the other: of every eighth value most intervals are known to lie below D.
    """
    size = np.diff(offsets)
    counts = (size - 1) // _EVERY + 2
    starts = np.cumsum(counts) - counts
    sample = np.repeat(np.arange(size.size), counts)
    own_size = size[sample]
    rank = np.minimum((np.arange(sample.size) - starts[sample]) * _EVERY, own_size - 1)
    at = cdf(ascending.take(offsets[sample] + rank), sample)
    excess = at - (rank + 1.0) / own_size
    highest, lowest = np.maximum.reduceat(excess, starts), np.minimum.reduceat(excess, starts)
    known = np.maximum(highest + 1.0 / size, -lowest)
    bound = np.maximum(at[1:] - (rank[:-1] + 1.0) / own_size[:-1], rank[1:] / own_size[:-1] - at[:-1])
    is_open = (bound >= known[sample[:-1]] - _ROUNDING) & (rank[1:] > rank[:-1])
    between = rank[:-1][is_open, None] + np.arange(1, _EVERY)
    inside = between < rank[1:][is_open, None]
    rank, sample = between[inside], np.broadcast_to(sample[:-1][is_open, None], between.shape)[inside]
    excess = cdf(ascending.take(offsets[sample] + rank), sample) - (rank + 1.0) / size[sample]
    np.maximum.at(highest, sample, excess)
    np.minimum.at(lowest, sample, excess)
    return np.maximum(highest + 1.0 / size, -lowest)


def of_order(ascending: FloatArray) -> tuple[float, ...]:
    """Shapiro and Wilk's sums (7,) over values (N,) in ascending order, see `audit.kernels.normality.COLUMNS`."""
    score, sq_sum = scores(ascending.size)
    half = len(score)
    span = ascending[: -half - 1 : -1] - ascending[:half]
    second, span_2 = (float(score[1]), float(span[1])) if half > 1 else (0.0, 0.0)
    first, span_1 = float(score[0]), float(span[0])
    deviation = ascending - np.add.reduce(ascending) / ascending.size
    deviation *= deviation
    span *= score
    return sq_sum, first, second, float(np.add.reduce(span[2:])), span_1, span_2, float(np.add.reduce(deviation))


@lru_cache(maxsize=256)
def scores(num_values: int) -> tuple[FloatArray, float]:
    """Expected order statistics (num_values // 2,) of the largest values, largest first, as Royston takes them.

    With twice the sum of their squares.
    """
    rank = np.arange(1.0, num_values // 2 + 1.0)
    score = np.asarray(-special.ndtri((rank - 0.375) / (num_values + 0.25)))
    return score, 2.0 * float(score @ score)
