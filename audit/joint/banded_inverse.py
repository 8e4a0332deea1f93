"""S^+ of a band: the entries that an image's neighbours ask for, and products with all of it (method.md section 11)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sfm_audit.audit.joint.band import in_blocks
from sfm_audit.audit.joint.banded import BandedFactor, both_ways
from sfm_audit.audit.joint.lapack import add_product, mirror
from sfm_audit.audit.kernels.joint_parts import near_entries
from sfm_audit.audit.kernels.joint_scores import BandArrays
from sfm_audit.loaders.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class BandedInverse:
    """S^+ = D^-1 P X P D^-1 = D^-1 (Y - A B^T - B A^T) D^-1, of which the blocks near the diagonal are at hand.

    near: per block i, the entries of Y at its rows and from its first column to its end in ``Band.ends``; views of
    ``flat``, where one follows the other. Zero in the border.
    aside, pull: (D, g + m) A = [G, V] and B = [H, -V K / 2], H = X G - G (G^T X G) / 2; by place.
    inverse_scale: (D,) 1 / D, zero for dead columns; as in the matrix.
    """

    factor: BandedFactor
    flat: FloatArray
    near: list[FloatArray]
    aside: FloatArray
    pull: FloatArray
    inverse_scale: FloatArray

    def __len__(self) -> int:
        return len(self.inverse_scale)

    def apply(self, right: FloatArray) -> FloatArray:
        """S^+ right, of (D,) or (D, c)."""
        columns = right.reshape(len(right), -1) * self.inverse_scale[:, None]
        return (self.factor.solve(columns) * self.inverse_scale[:, None]).reshape(right.shape)

    def times(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """S^+ (all rows, at some columns) @ right: (D, c) of (k, c)."""
        padded = np.zeros((len(self), right.shape[1]))
        padded[columns] = right
        return self.apply(padded)

    def rows(self, columns: IntArray) -> FloatArray:
        """(k, D) rows of S^+."""
        return self.times(columns, np.eye(columns.size)).T

    def within(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """The entries of S^+ at some columns @ right: (k, c) of (k, c)."""
        if not self._is_near(columns):
            return self.times(columns, right)[columns]
        place = self.factor.band.place[columns]
        order = np.argsort(place, kind="stable")
        order = order[: np.searchsorted(place[order], self.factor.band.num_banded)]
        entries = near_entries(place[order], self.factor.band.starts, self.flat, *_places_in_flat(self.near))
        if entries is None:
            return np.asarray(self.block(columns) @ right)
        scale, aside, pull = self.inverse_scale[columns][:, None], self.aside[place], self.pull[place]
        scaled = right * scale
        out = np.zeros_like(scaled)
        out[order] = entries @ scaled[order]
        out -= aside @ (pull.T @ scaled) + pull @ (aside.T @ scaled)
        return np.asarray(scale * out)

    def blocks(self, columns: IntArray) -> FloatArray:
        """(B, k, k) entries of S^+ at columns (B, k)."""
        place, band = self.factor.band.place[columns], self.factor.band
        lower = np.minimum(place[:, :, None], place[:, None, :])
        higher = np.maximum(place[:, :, None], place[:, None, :])
        starts, sizes = _places_in_flat(self.near)
        in_band = higher < band.num_banded
        number = np.where(in_band, band.number(lower), 0)
        origin = band.starts[number]
        too_far = in_band & (higher - origin >= sizes[number])
        at = starts[number] + (lower - origin) * sizes[number] + higher - origin
        out = np.where(in_band, self.flat.take(np.where(in_band & ~too_far, at, 0)), 0.0)
        outer = self.aside[place] @ self.pull[place].swapaxes(1, 2)
        out -= outer + outer.swapaxes(1, 2)
        scale = self.inverse_scale[columns]
        out *= scale[:, None, :] * scale[:, :, None]
        for k in np.flatnonzero(too_far.any(axis=(1, 2))).tolist():
            out[k] = self.block(columns[k])
        return np.asarray(out)

    def between(self, block: int, other: int) -> FloatArray:
        """Entries of Y at the rows of a block of the band and at the columns of the same or of a neighbouring one."""
        if other < block:
            return self.between(other, block).T
        starts = self.factor.band.starts
        return self.near[block][:, starts[other] - starts[block] : starts[other + 1] - starts[block]]

    def arrays(self) -> BandArrays:
        """As compiled sums take it."""
        band, starts = self.factor.band, _places_in_flat(self.near)
        outer = self.aside, self.pull
        return BandArrays(band.place, band.starts, self.flat, *starts, *outer, self.inverse_scale)

    def _is_near(self, columns: IntArray) -> bool:
        """Whether all entries at some columns are at hand."""
        place, band = self.factor.band.place[columns], self.factor.band
        place = place[place < band.num_banded]
        return not place.size or bool(place.max() < band.ends[band.number(place.min())])

    @property
    def trace(self) -> float:
        """Trace of P X P, in units of unit diagonal."""
        own = sum(float(np.einsum("ii->", block[:, : len(block)])) for block in self.near)
        return own - 2.0 * float((self.aside * self.pull).sum())

    def block(self, columns: IntArray) -> FloatArray:
        """(k, k) entries of S^+ at some columns."""
        if not self._is_near(columns):
            return self.rows(columns)[:, columns]
        place, band = self.factor.band.place[columns], self.factor.band
        by_place = np.argsort(place, kind="stable")
        place = place[by_place]
        inner = int(np.searchsorted(place, band.num_banded))
        number = band.number(place[:inner])
        out = np.zeros((place.size, place.size))
        bounds = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1, [inner]]).tolist()
        for start, stop in pairwise(bounds) if inner else ():
            origin = band.starts[number[start]]
            part = self.near[number[start]][np.ix_(place[start:stop] - origin, place[start:inner] - origin)]
            out[start:stop, start:inner] = part
            out[stop:inner, start:stop] = part[:, stop - start :].T
        outer = self.aside[place] @ self.pull[place].T
        out -= outer + outer.T
        back = np.argsort(by_place, kind="stable")
        scale = self.inverse_scale[columns]
        return out[np.ix_(back, back)] * scale * scale[:, None]


def _places_in_flat(near: list[FloatArray]) -> tuple[IntArray, IntArray]:
    """(b + 1,) where each block begins, and (b,) how many columns it has."""
    sizes = np.array([block.size for block in near], dtype=np.int64)
    return np.concatenate([[0], np.cumsum(sizes)]), np.array([block.shape[1] for block in near], dtype=np.int64)


def banded_inverse(factor: BandedFactor, inverse_scale: FloatArray) -> BandedInverse:
    """Return S^+ in the units of the matrix.

    Notes
    -----
    From the middle to both ends, n the block before: X_(n, i) = -X_(n, n) U_i, X_(i, i) = P_i - U_i^T X_(n, i), and for
    all other j at hand X_(i, j) = -U_i^T X_(n, j).
    """
    entries = _Entries(factor)
    entries.fill()
    null = factor.null
    pulled = factor.solve_in_order(null)
    pull = np.hstack([pulled - 0.5 * null @ (null.T @ pulled), -0.5 * factor.beside @ factor.corner])
    aside = np.hstack([null, factor.beside])
    return BandedInverse(factor, entries.flat, entries.near, aside, pull, inverse_scale)


class _Entries:
    """``flat`` and ``near`` of `BandedInverse`."""

    def __init__(self, factor: BandedFactor) -> None:
        self._factor, self._middle = factor, factor.band.middle
        self._starts, self._ends = factor.band.starts.tolist(), factor.band.ends.tolist()
        shapes = [(b - a, end - a) for (a, b), end in zip(pairwise(self._starts), self._ends, strict=True)]
        self.flat = np.empty(sum(rows * columns for rows, columns in shapes))
        self.near = in_blocks(self.flat, shapes)

    def fill(self) -> None:
        """Compute them all; those of the middle first, which are asked for on either side of it."""
        self._at(self._middle, self._middle)[...] = self._factor.pivots[self._middle]
        reached = int(np.searchsorted(self._starts, self._ends[self._middle]))
        for block in range(self._middle + 1, reached):
            self._behind(block)
        both_ways(self._factor.band, lambda order: self._outwards(order, reached))

    def _outwards(self, order: list[tuple[int, int]], reached: int) -> None:
        for block, following in reversed(order):
            if block < following:
                self._in_front(block)
            elif block >= reached:
                self._behind(block)

    def _at(self, block: int, other: int) -> FloatArray:
        """What is at hand of a block's rows at the columns of the same one or another behind it."""
        origin = self._starts[block]
        return self.near[block][:, self._starts[other] - origin : self._starts[other + 1] - origin]

    def _behind(self, block: int) -> None:
        """The columns of a block behind the middle, in all rows from the middle on that have them at hand."""
        step = self._factor.step(block)
        for i in range(block - 1, self._middle - 1, -1):
            columns = self._at(i, block)
            if not columns.size:
                break
            add_product(columns, self._at(i, block - 1), step[:, : columns.shape[1]], -1.0, 0.0)
        self._own(block, self._at(block - 1, block))

    def _in_front(self, block: int) -> None:
        """The rows of a block in front of the middle."""
        step = self._factor.step(block)
        beside = self.near[block][:, step.shape[1] :]
        add_product(beside, step.T, self.near[block + 1][:, : beside.shape[1]], -1.0, 0.0)
        self._own(block, self._at(block, block + 1).T)

    def _own(self, block: int, beside: FloatArray) -> None:
        """The entries at a block's rows and columns; ``beside``: at the rows of the block before."""
        own = self._at(block, block)
        own[...] = self._factor.pivots[block]
        add_product(own, self._factor.step(block).T, beside, -1.0)
        mirror(own)
