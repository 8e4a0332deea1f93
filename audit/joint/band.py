"""In which order are S and M banded? What couples with the next columns only, and what couples with everything."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from sfm_audit.audit.joint.matrix import PairMatrix, Symmetric, csr_of, groups_of
from sfm_audit.audit.kernels.joint_matrix import BandPlaces, band_of_blocks
from sfm_audit.loaders.arrays import FloatArray, IntArray

_MIN_BLOCKS: Final = 4  # fewer are no band
_FAR_REACHING: Final = (8, 4, 2)  # times as many couplings as a column commonly has: it belongs to the border
_MAX_BORDER: Final = 128
_MORE_BEHIND: Final = (
    4  # blocks than in front of the middle: what the middle has at hand there is computed before both sides are
)


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """How the columns of a sparse symmetric matrix are ordered into blocks that couple with the next one only.

    order: (D,) column at each place.    place: (D,) of each column.    width: how far places couple.
    starts: (b + 1,) where each block begins and the last one ends, none longer than the width; the border behind them
    couples with everything.
    ends: (b,) behind the last place that is asked for beside one of the block's: places that couple with the same
    column, as all of an image's neighbours do, and the next block.
    """

    order: IntArray
    place: IntArray
    width: int
    starts: IntArray
    ends: IntArray

    @property
    def num_banded(self) -> int:
        """Places of the band."""
        return int(self.starts[-1])

    def blocks(self) -> Iterator[slice]:
        """Places of each block."""
        for start, stop in pairwise(self.starts.tolist()):
            yield slice(start, stop)

    def number(self, place: IntArray) -> IntArray:
        """Which block has each of some places; one behind the last for the border."""
        return np.asarray(np.searchsorted(self.starts, place, side="right") - 1)

    @property
    def middle(self) -> int:
        """Which block is eliminated last: in front of it from the first on, behind it from the last one on."""
        return max(0, (len(self.starts) - 1 - _MORE_BEHIND) // 2)

    def chains(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Return in which order blocks are eliminated on either side of the middle, each with the one it leads to."""
        middle, last = self.middle, len(self.starts) - 2
        return [(i, i + 1) for i in range(middle)], [(i, i - 1) for i in range(last, middle, -1)]

    @property
    def num_border(self) -> int:
        """Columns of the border."""
        return len(self.order) - self.num_banded


def band_of(matrix: Symmetric) -> Band | None:
    """Order the columns (reverse Cuthill-McKee), far reaching ones in a border; None where no band is worth it."""
    pattern, group = groups_of(matrix)
    sizes = np.bincount(group, minlength=pattern.shape[0])
    couplings = pattern @ sizes
    common = np.median(couplings[group]) if group.size else 0.0
    borders = {0: np.zeros(0, dtype=np.int64)}
    for times in _FAR_REACHING:
        border = np.flatnonzero(couplings > times * common)
        if sizes[border].sum() <= _MAX_BORDER:
            borders.setdefault(border.size, border)
    bands = [_ordered(pattern, group, border) for border in borders.values()]
    worth = [band for band in bands if band.num_banded >= _MIN_BLOCKS * band.width]
    return min(worth, key=lambda band: band.width + band.num_border) if worth else None


def _ordered(pattern: sparse.csr_array, group: IntArray, border: IntArray) -> Band:
    """The band that is left when some groups of columns are its border."""
    inner = np.delete(np.arange(pattern.shape[0]), border)
    within = sparse.csr_array(pattern[inner][:, inner]) if border.size else pattern
    by_rank = reverse_cuthill_mckee(within, symmetric_mode=True)
    rank = np.empty(pattern.shape[0], dtype=np.int64)
    rank[np.concatenate([inner[by_rank], border])] = np.arange(rank.size)
    order = np.argsort(rank[group], kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(order.size)
    sizes = np.bincount(group, minlength=rank.size)[inner]
    ends = np.cumsum(sizes[by_rank])
    last = ends[rank[inner]] - 1  # place of each group's last column
    furthest = _furthest(within, last)
    reach = np.repeat(furthest[by_rank], sizes[by_rank])
    width = max(int((reach - np.arange(reach.size)).max(initial=0)), 1)
    starts = _starts(reach, width)
    together = np.repeat(_furthest(within, furthest)[by_rank], sizes[by_rank])
    return Band(order, place, width, starts, _ends(together, starts))


def _furthest(pattern: sparse.csr_array, place: IntArray) -> IntArray:
    """(G,) the last place of each group and of those that it couples with."""
    out, used = place.copy(), np.flatnonzero(np.diff(pattern.indptr))
    if used.size:
        out[used] = np.maximum(place[used], np.maximum.reduceat(place[pattern.indices], pattern.indptr[used]))
    return out


def _starts(reach: IntArray, width: int) -> IntArray:
    """Blocks as short as can be when each ends behind all that the one before it couples with, or half a width long.

    reach : (n,) last place that each place couples with
    """
    behind = np.maximum.accumulate(reach) + 1
    starts = [0]
    while starts[-1] < reach.size:
        here = starts[-1]
        starts.append(min(max(int(behind[max(here - 1, 0)]), here + (width + 1) // 2), reach.size))
    return np.array(starts, dtype=np.int64)


def _ends(together: IntArray, starts: IntArray) -> IntArray:
    """(b,) behind all that is asked for beside places up to the end of each block, and not before the next one ends.

    together : (n,) last place that is asked for beside each
    """
    behind = np.maximum.accumulate(together) + 1
    return np.asarray(np.maximum(behind[starts[1:] - 1], np.append(starts[2:], starts[-1:])[: starts.size - 1]))


class BandBlocks(NamedTuple):
    """Entries of a matrix in the order of a band; blocks are views of what lies in one piece.

    diagonal: (w_i, w_i) of each block.    below: (w_(i+1), w_i) of each but the last.    border: (D, m) last columns.
    """

    flat: FloatArray
    flat_below: FloatArray
    diagonal: list[FloatArray]
    below: list[FloatArray]
    border: FloatArray

    @classmethod
    def of(cls, band: Band, flat: FloatArray, flat_below: FloatArray, border: FloatArray) -> BandBlocks:
        """Return them from what lies in one piece."""
        widths = np.diff(band.starts).tolist()
        below = in_blocks(flat_below, list(zip(widths[1:], widths[:-1], strict=True)))
        return cls(flat, flat_below, in_blocks(flat, [(w, w) for w in widths]), below, border)


def in_blocks(flat: FloatArray, shapes: list[tuple[int, int]]) -> list[FloatArray]:
    """Return what lies in one piece as one block after the other."""
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
    return [flat[a:b].reshape(shape) for (a, b), shape in zip(pairwise(ends), shapes, strict=True)]


def band_blocks(matrix: Symmetric, band: Band, scale: FloatArray) -> BandBlocks:
    """Return E matrix E by place, E diagonal, ``scale`` (D,)."""
    if isinstance(matrix, PairMatrix):
        compiled = band_of_blocks(matrix.blocks, BandPlaces(band.place, band.starts), scale)
        if compiled is not None:
            return BandBlocks.of(band, *compiled)
    scaled = sparse.diags_array(scale) @ csr_of(matrix) @ sparse.diags_array(scale)
    ordered = sparse.csr_array(sparse.csr_array(scaled)[band.order][:, band.order])
    blocks = list(band.blocks())
    diagonal = [ordered[own, own].toarray().ravel() for own in blocks]
    below = [ordered[following, own].toarray().ravel() for own, following in pairwise(blocks)]
    flat, flat_below = (np.concatenate([np.empty(0), *each]) for each in (diagonal, below))
    return BandBlocks.of(band, flat, flat_below, ordered[:, band.num_banded :].toarray())


def dense_of(matrix: Symmetric, scale: FloatArray) -> FloatArray:
    """Return E matrix E (D, D), E diagonal, ``scale`` (D,)."""
    if isinstance(matrix, PairMatrix):
        everything = np.arange(scale.size)
        compiled = band_of_blocks(matrix.blocks, BandPlaces(everything, np.array([0, scale.size])), scale)
        if compiled is not None:
            return compiled[0].reshape(scale.size, scale.size)
    return np.asarray((sparse.diags_array(scale) @ csr_of(matrix) @ sparse.diags_array(scale)).toarray())
