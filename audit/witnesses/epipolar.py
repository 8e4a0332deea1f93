"""Do the verified matches of image pairs satisfy the model's cameras? Sampson distances, many pairs at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.witnesses.rays import Float32Array, RayCache, centres
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import MatchedPair, PairSource, SparseModel

_MATCHES_AT_A_TIME: Final = 200_000


@dataclass(frozen=True, slots=True, eq=False)
class PairCounts:
    """Verified pairs of a model.

    image_idx: (k, 2) rows of the images.    num_matches: (k,) verified matches whose distance is known.
    num_far: (k,) of these, farther from the epipolar geometry of the model's cameras than the threshold.
    """

    image_idx: IntArray
    num_matches: IntArray
    num_far: IntArray


def sampson_px(rays_first: Float32Array, rays_second: Float32Array, baseline: FloatArray) -> FloatArray:
    """Return (m,) Sampson distances, px: how far, to first order, both points have to move to meet.

    Parameters
    ----------
    rays_first, rays_second : (m, 4) as of `image_rays`        baseline : (m, 3) unit vectors between the two centres

    Notes
    -----
    With unit rays w1, w2 in the world frame and the unit baseline b the constraint is c = b . (w1 x w2) = 0. A small
    turn of w1 changes c by the part of w2 x b across w1, of squared length 1 - (b . w2)^2 - c^2; px per rad s1, s2:
    d^2 = c^2 / ((1 - (b . w2)^2 - c^2) / s1^2 + (1 - (b . w1)^2 - c^2) / s2^2). NaN where a ray is unknown or both lie
    along the baseline.
    """
    w1, w2 = rays_first[:, :3].astype(np.float64), rays_second[:, :3].astype(np.float64)
    with np.errstate(all="ignore"):
        sq_c = np.einsum("ni,ni->n", baseline, np.cross(w1, w2)) ** 2
        along_first = np.einsum("ni,ni->n", baseline, w1)
        along_second = np.einsum("ni,ni->n", baseline, w2)
        slope_first = (1.0 - along_second**2 - sq_c) / rays_first[:, 3].astype(np.float64) ** 2
        slope_second = (1.0 - along_first**2 - sq_c) / rays_second[:, 3].astype(np.float64) ** 2
        return np.asarray(np.sqrt(sq_c / (slope_first + slope_second)))


def count_far(model: SparseModel, source: PairSource, threshold_px: float) -> PairCounts:
    """Go once through all verified pairs and count the matches that are farther off than the threshold.

    Raises
    ------
    LoadError
        The pairs cannot be read.
    """
    cache, centre = RayCache(model, source), centres(model)
    parts = [_count(batch, cache, centre, threshold_px) for batch in _batches(source.pairs())]
    empty = PairCounts(np.empty((0, 2), np.int64), np.empty(0, np.int64), np.empty(0, np.int64))
    parts = [part for part in parts if len(part.image_idx)] or [empty]
    return PairCounts(
        np.concatenate([part.image_idx for part in parts]),
        np.concatenate([part.num_matches for part in parts]),
        np.concatenate([part.num_far for part in parts]),
    )


def _batches(pairs: Iterable[MatchedPair]) -> Iterator[list[MatchedPair]]:
    """Gather pairs until their matches are worth a round of array operations."""
    batch: list[MatchedPair] = []
    num = 0
    for pair in pairs:
        batch.append(pair)
        num += len(pair.keypoint_idx)
        if num >= _MATCHES_AT_A_TIME:
            yield batch
            batch, num = [], 0
    if batch:
        yield batch


def _count(batch: list[MatchedPair], cache: RayCache, centre: FloatArray, threshold_px: float) -> PairCounts:
    first, second, sizes = [], [], []
    for pair in batch:
        first.append(cache.rays(pair.first_idx)[pair.keypoint_idx[:, 0]])
        second.append(cache.rays(pair.second_idx)[pair.keypoint_idx[:, 1]])
        sizes.append(len(pair.keypoint_idx))
    image_idx = np.array([(pair.first_idx, pair.second_idx) for pair in batch], dtype=np.int64)
    with np.errstate(all="ignore"):
        baseline = centre[image_idx[:, 1]] - centre[image_idx[:, 0]]
        baseline = baseline / np.linalg.norm(baseline, axis=1, keepdims=True)
    distance = sampson_px(np.concatenate(first), np.concatenate(second), np.repeat(baseline, sizes, axis=0))
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    known = np.add.reduceat(~np.isnan(distance), starts, dtype=np.int64)
    far = np.add.reduceat(distance > threshold_px, starts, dtype=np.int64)
    return PairCounts(image_idx, known, far)
