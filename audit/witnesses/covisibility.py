"""Which images share how many points, and in how many parts does the model hang together? (method.md section 13)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels import witnesses as kernels
from sfm_audit.loaders.arrays import BoolArray, Int32Array, IntArray

_MAX_IMAGES_IN_FULL: Final = 1500  # whose pairs are counted in a full matrix: 18 MB
_MAX_PAIRS: Final = 1 << 20  # of images that see a point, each twice, in memory at the same time


@dataclass(frozen=True, slots=True, eq=False)
class Covisibility:
    """Pairs of images that share points, each once: first < second (k,), num_shared (k,) points; num_images."""

    first: IntArray
    second: IntArray
    num_shared: IntArray
    num_images: int

    def at_least(self, num: int) -> Covisibility:
        """Return the pairs that share so many points."""
        kept = self.num_shared >= num
        return Covisibility(self.first[kept], self.second[kept], self.num_shared[kept], self.num_images)

    def degree(self) -> IntArray:
        """Return (I,) number of neighbours."""
        both = np.concatenate([self.first, self.second])
        return np.bincount(both, minlength=self.num_images).astype(np.int64)

    def strongest(self) -> IntArray:
        """Return (I,) points shared with the strongest neighbour, 0 without any."""
        out = np.zeros(self.num_images, dtype=np.int64)
        np.maximum.at(out, self.first, self.num_shared)
        np.maximum.at(out, self.second, self.num_shared)
        return out

    def components(self) -> IntArray:
        """Return (I,) which part each image is in; 0 is the largest."""
        ones = np.ones(len(self.first), dtype=np.int8)
        graph = coo_array((ones, (self.first, self.second)), shape=(self.num_images, self.num_images))
        labels = connected_components(graph, directed=False)[1]
        order = np.argsort(-np.bincount(labels, minlength=1), kind="stable")
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        return np.asarray(rank[labels], dtype=np.int64) if self.num_images else np.empty(0, np.int64)

    def shares(self, image_idx: IntArray, num: int) -> BoolArray:
        """Whether the images of each pair (k, 2) share at least ``num`` points."""
        kept = self.at_least(num)
        known = np.sort(kept.first * self.num_images + kept.second)
        low, high = image_idx.min(axis=1, initial=self.num_images), image_idx.max(axis=1, initial=0)
        return np.isin(low * self.num_images + high, known)


@dataclass(frozen=True, slots=True, eq=False)
class SeenBy:
    """Which images see each point, by their inliers; an image counts once, however often it observes a point.

    offsets: (P + 1,) point p is seen by image_idx[offsets[p]:offsets[p + 1]], ascending.
    """

    offsets: IntArray
    image_idx: Int32Array


def covisibility(residuals: ModelResiduals, num_points: int) -> tuple[SeenBy, Covisibility]:
    """Turn the inliers of images round, and count the shared points of all pairs of images."""
    num_images = len(residuals.offsets) - 1
    found = kernels.shared_points(residuals.offsets, residuals.point_idx, num_points)
    if found is not None:
        return SeenBy(*found[0]), Covisibility(*found[1], num_images)
    seen_by = _turned(residuals, num_points)
    pairs = _in_full if num_images <= _MAX_IMAGES_IN_FULL else _by_product
    return seen_by, Covisibility(*pairs(seen_by, num_images), num_images)


def _turned(residuals: ModelResiduals, num_points: int) -> SeenBy:
    """Sort observations by their point; those of an image that follow each other count once."""
    num_images, num = len(residuals.offsets) - 1, len(residuals.point_idx)
    given = np.ones(num, dtype=np.int8), residuals.point_idx.astype(np.int32), residuals.offsets.astype(np.int32)
    by_image = csr_array(given, shape=(num_images, num_points)) if num else csr_array((num_images, num_points))
    seen = by_image.tocsc()
    seen.sum_duplicates()
    return SeenBy(seen.indptr.astype(np.int64), seen.indices.astype(np.int32, copy=False))


_Pairs: TypeAlias = tuple[IntArray, IntArray, IntArray]
"""first < second, num_shared: (k,) each."""


def _in_full(seen_by: SeenBy, num_images: int) -> _Pairs:
    """Count the pairs of images of each point in a matrix of all pairs."""
    image_idx, ends = seen_by.image_idx, seen_by.offsets[1:]
    total = np.zeros(num_images * num_images, dtype=np.int64)
    for points in _pieces(seen_by.offsets):
        first, last = int(seen_by.offsets[points.start]), int(seen_by.offsets[points.stop])
        own = image_idx[first:last].astype(np.int64)
        at = np.arange(first, last, dtype=np.int64)
        end = np.repeat(ends[points], np.diff(seen_by.offsets[points.start : points.stop + 1]))
        keys = [np.empty(0, dtype=np.int64)]
        step = 1
        while at.size:  # pairs of an image with the step-th behind it among those that see the point
            kept = at + step < end
            at, end = at.compress(kept), end.compress(kept)
            keys.append(own[at - first] * num_images + own[at + step - first])
            step += 1
        total += np.bincount(np.concatenate(keys), minlength=total.size)
    found = np.flatnonzero(total)
    return found // num_images, found % num_images, total[found]


def _pieces(offsets: IntArray) -> Iterator[slice]:
    """Yield consecutive points with so many pairs of images as are in memory together."""
    num = np.diff(offsets)
    before = np.concatenate([[0], np.cumsum(num * num)])
    start = 0
    while start < num.size:
        stop = max(int(np.searchsorted(before, before[start] + _MAX_PAIRS, side="right")) - 1, start + 1)
        yield slice(start, stop)
        start = stop


def _by_product(seen_by: SeenBy, num_images: int) -> _Pairs:
    """Count the pairs of images of each point by a sparse product, where a matrix of all pairs is too large."""
    given = np.ones(len(seen_by.image_idx), dtype=np.int32), seen_by.image_idx, seen_by.offsets
    seen = csr_array(given, shape=(len(seen_by.offsets) - 1, num_images))
    shared = (seen.T.tocsr() @ seen).tocoo()
    upper = shared.row < shared.col
    first, second, num_shared = (each[upper].astype(np.int64) for each in (shared.row, shared.col, shared.data))
    return first, second, num_shared


@dataclass(frozen=True, slots=True, eq=False)
class Cuts:
    """Where a graph hangs by one edge or one vertex: bridges (b, 2), and articulation (I,) vertices."""

    bridges: IntArray
    articulation: BoolArray


def cuts_of(graph: Covisibility) -> Cuts:
    """Return bridges and articulation vertices, by Tarjan's depth-first search."""
    if (found := kernels.cuts(graph.first, graph.second, graph.num_images)) is not None:
        bridges, articulation = found
        return Cuts(bridges[np.lexsort(bridges.T[::-1])], articulation)
    search = _Search(graph)
    for root in range(graph.num_images):
        search.run(root)
    bridges = np.array(sorted(search.bridges), dtype=np.int64).reshape(-1, 2)
    return Cuts(bridges, np.array(search.articulation, dtype=bool))


class _Search:
    """Depth-first search without recursion: `order` of the visit, `low`est order reached from below."""

    def __init__(self, graph: Covisibility) -> None:
        self._graph = graph
        n = graph.num_images
        self.order, self.low = [-1] * n, [0] * n
        self.articulation = [False] * n
        self.bridges: list[tuple[int, int]] = []
        self._num_visited = 0

    @cached_property
    def _neighbours(self) -> list[list[int]]:
        graph = self._graph
        ends = np.concatenate([graph.first, graph.second]), np.concatenate([graph.second, graph.first])
        by_start = np.argsort(ends[0], kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(ends[0], minlength=graph.num_images))]).tolist()
        others = ends[1][by_start].tolist()
        return [others[first:last] for first, last in pairwise(offsets)]

    def run(self, root: int) -> None:
        """Visit what can be reached from ``root``."""
        if self.order[root] >= 0:
            return
        self._enter(root)
        path = [(root, -1, iter(self._neighbours[root]))]
        num_children = 0
        while path:
            at, parent, rest = path[-1]
            following = next(rest, None)
            if following is None:
                path.pop()
                if parent >= 0:
                    self._leave(at, parent, is_root=parent == root)
                    num_children += parent == root
            elif self.order[following] < 0:
                self._enter(following)
                path.append((following, at, iter(self._neighbours[following])))
            elif following != parent:
                self.low[at] = min(self.low[at], self.order[following])
        self.articulation[root] = num_children > 1

    def _enter(self, at: int) -> None:
        self.order[at] = self.low[at] = self._num_visited
        self._num_visited += 1

    def _leave(self, at: int, parent: int, *, is_root: bool) -> None:
        self.low[parent] = min(self.low[parent], self.low[at])
        if self.low[at] > self.order[parent]:
            self.bridges.append((min(at, parent), max(at, parent)))
        if self.low[at] >= self.order[parent] and not is_root:
            self.articulation[parent] = True
