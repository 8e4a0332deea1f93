"""What pairs of images have in common over the points that both should see, summed up pair by pair."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, TypeAlias

import numpy as np

from sfm_audit.audit.witnesses.should_see import ShouldSee
from sfm_audit.loaders.arrays import FloatArray, IntArray

_AT_ONCE: Final = 1 << 17  # pairs of looks at one point in memory

PairColumns: TypeAlias = tuple[
    IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray
]
"""The fields of `audit.witnesses.fold.PairSums`."""


def sums_of_pairs(seen: ShouldSee, log_distance: FloatArray, num_of_point: IntArray) -> PairColumns:
    """Add up over all pairs of looks at a point.

    Parameters
    ----------
    seen : who should see what, image by image        log_distance : (m,)
    num_of_point : (P,) looks at each point; few beside the number of images, or full matrices are faster
    """
    order = np.argsort(seen.point.astype(np.uint16) if seen.num_points <= 1 << 16 else seen.point, kind="stable")
    image = seen.image[order]
    rate = np.bincount(seen.point, seen.sees, minlength=seen.num_points) / np.maximum(num_of_point, 1)
    columns = np.empty((6, len(order)))
    for row, values in enumerate((*seen.ray, log_distance, seen.sees)):
        columns[row] = values[order]
    rest = np.subtract(columns[4], np.repeat(rate, num_of_point), out=columns[5])
    is_there = np.zeros(seen.num_images**2, dtype=np.bool_)
    for first, second in _pairs(num_of_point):
        is_there[image.take(first) * seen.num_images + image.take(second)] = True
    key = np.flatnonzero(is_there)
    place = np.zeros(is_there.size, dtype=np.int32)
    place[key] = np.arange(key.size)
    num, sums = np.zeros(key.size, dtype=np.int64), np.zeros((5, key.size))
    for first, second in _pairs(num_of_point):
        at = place.take(image.take(first) * seen.num_images + image.take(second)).astype(np.int64)
        num += np.bincount(at, minlength=key.size)
        for row, values in enumerate(_of_looks(columns, first, second)):
            sums[row] += np.bincount(at, values, minlength=key.size)
    both, either, cosine, log_ratio, rests = sums
    own_rest = np.bincount(image, rest * rest, minlength=seen.num_images).astype(np.float64)
    firsts, seconds = (each.astype(np.int64) for each in np.divmod(key, seen.num_images))
    return firsts, seconds, num.astype(np.float64), both, either, cosine, log_ratio, rests, own_rest


def _of_looks(columns: FloatArray, first: IntArray, second: IntArray) -> Iterator[FloatArray]:
    """Yield seen by both, by either, cosine, logarithm of the ratio of distances, product of the rests: (k,) each."""
    x, y, z, log_distance, sees, rest = columns
    both = sees.take(first) * sees.take(second)
    yield both
    yield sees.take(first) + sees.take(second) - both
    cosine = x.take(first) * x.take(second)
    cosine += y.take(first) * y.take(second)
    cosine += z.take(first) * z.take(second)
    yield cosine
    yield log_distance.take(first) - log_distance.take(second)
    yield rest.take(first) * rest.take(second)


def _pairs(num_of_point: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs of looks (k,), rows of looks in the order of points: of some points at a time, nearest rows first."""
    ends = np.cumsum(num_of_point)
    before = np.concatenate([[0], np.cumsum(num_of_point * (num_of_point - 1) // 2)])
    start = 0
    while start < num_of_point.size:
        stop = max(int(np.searchsorted(before, before[start] + _AT_ONCE, side="right")) - 1, start + 1)
        num = num_of_point[start:stop]
        end = np.repeat(ends[start:stop], num)
        at = np.arange(ends[start] - num_of_point[start], ends[stop - 1])
        first, second = [], []
        for step in range(1, int(num.max())):
            kept = at + step < end
            at, end = at.compress(kept), end.compress(kept)
            first.append(at)
            second.append(at + step)
        if first:
            yield np.concatenate(first), np.concatenate(second)
        start = stop
