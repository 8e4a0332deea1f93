"""S^+ M S^+ near the diagonal, where S and M are banded: one sweep forward, one back (method.md section 11)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.joint.band import BandBlocks, band_blocks
from sfm_audit.audit.joint.banded import BandedFactor, across, both_ways
from sfm_audit.audit.joint.banded_inverse import BandedInverse
from sfm_audit.audit.joint.lapack import add_both, add_product, mirror, multiply
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, distinct


def banded_sandwiches(main: BandedInverse, meat: Symmetric, blocks: Sequence[IntArray]) -> list[FloatArray | None]:
    """Return S^+ M S^+ at each block of columns (k,); None of those that span more than two blocks of the band.

    Notes
    -----
    S^+ M S^+ = P X M X P: scores are off the points, track by track, so that M has the null directions of S, M G = 0.
    As block after block is eliminated (U_i, P_i and n, the next block, as in `BandedFactor`), M follows:
    N_i = M_(n, i) - U_i M_(i, i),  M_(n, n) -= H_i + H_i^T,  H_i = U_i (M_(n, i) - U_i M_(i, i) / 2)^T.
    Then back, Y = X M X, with K_i the lower triangle of M_(i, i) and half its diagonal, L_n that of Y_(n, n):
    Y_(i, i) = H_i + H_i^T,  H_i = (X_(i, n) N_i + P_i K_i) P_i + U_i^T L_n U_i;  where asked for,
    Y_(n, i) = X_(n, n) N_i P_i - Y_(n, n) U_i.
    All this is of the band; with X + V K V^T in the place of X and Q = (X + V K V^T) M V, the border adds
    B V^T + V B^T, B = Q K - V K V^T M V K / 2.
    """
    factor, band, null, scale = main.factor, main.factor.band, main.factor.null, main.inverse_scale

    def times(values: FloatArray) -> FloatArray:
        """The meat in scaled units times (D, c), by place."""
        return ((meat @ (values[band.place] * scale[:, None])) * scale[:, None])[band.order]

    near = _Near.of(main, band_blocks(meat, band, scale))
    pulled = factor.solve_in_order(times(factor.solve_in_order(null)))
    pull = pulled - 0.5 * null @ (null.T @ pulled)  # P Y P = Y - G H^T - H G^T
    aside, pull = main.aside, np.hstack([pull, -_of_border(factor, times)])
    out: list[FloatArray | None] = [None] * len(blocks)
    for size in {block.size for block in blocks}:
        numbers = [k for k, block in enumerate(blocks) if block.size == size]
        columns = np.stack([blocks[k] for k in numbers])
        place = band.place[columns]
        values, too_far = near.at(place)
        outer = aside[place] @ pull[place].swapaxes(1, 2)
        values -= outer + outer.swapaxes(1, 2)
        values *= scale[columns][:, None, :] * scale[columns][:, :, None]
        for k, value, is_far in zip(numbers, values, too_far.tolist(), strict=True):
            out[k] = None if is_far else value
    return out


def _of_border(factor: BandedFactor, times: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """B (D, m) by place: what the border adds to the sandwich of the band alone is B V^T + V B^T."""
    beside, corner = factor.beside, factor.corner
    if not corner.size:
        return beside
    weighed = times(beside)
    inner = corner @ (beside.T @ weighed) @ corner
    return np.asarray(factor.solve_in_order(weighed) @ corner - 0.5 * beside @ inner)


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Y_(i, i) of each block i, and N_i between blocks, in the memory of the meat."""

    main: BandedInverse
    diagonal: list[FloatArray]
    below: list[FloatArray]

    @classmethod
    def of(cls, main: BandedInverse, meat: BandBlocks) -> _Near:
        """Go to the middle and back."""
        band, middle = main.factor.band, meat.diagonal[main.factor.band.middle]
        out = cls(main, meat.diagonal, meat.below)
        for lost in both_ways(band, out._inwards):
            middle -= lost
        mirror(middle.T)
        half = out._half(band.middle)
        add_both(middle.T, half, main.factor.pivots[band.middle], keep=0.0)
        mirror(middle.T)
        both_ways(band, out._outwards)
        return out

    def _inwards(self, order: list[tuple[int, int]]) -> FloatArray:
        """Eliminate blocks on one side of the middle; return what it loses by them."""
        factor, middle = self.main.factor, self.main.factor.band.middle
        lost = np.zeros_like(self.diagonal[middle])
        for block, following in order:
            step, beside = factor.step(block), across(self.below, middle, block)
            half = beside.copy(order="K")
            mirror(self.diagonal[block].T)
            add_product(half, step, self.diagonal[block], -0.5)
            to, sign = (lost, 1.0) if following == middle else (self.diagonal[following], -1.0)
            add_both(to.T, step, half, sign)
            np.subtract(half, beside, out=beside)
            beside += half
        return lost

    def _outwards(self, order: list[tuple[int, int]]) -> None:
        """Y_(i, i) of the blocks on one side of the middle."""
        factor, middle = self.main.factor, self.main.factor.band.middle
        for block, following in reversed(order):
            step, own, before = factor.step(block), self.diagonal[block].T, self.diagonal[following].T
            half = self._half(block)
            add_product(half, self.main.between(block, following), across(self.below, middle, block))
            add_both(own, half, factor.pivots[block], keep=0.0)
            moved = step.T.copy(order="K")
            multiply(moved, before)
            moved -= 0.5 * before.diagonal() * step.T
            add_both(own, moved, step.T)
            mirror(own)

    def _half(self, block: int) -> FloatArray:
        """P_i K_i; half of the diagonal of M_(i, i) goes."""
        lower = self.diagonal[block].T
        np.einsum("ii->i", lower)[...] *= 0.5
        half = self.main.factor.pivots[block].copy()
        multiply(half, lower)
        return half

    def at(self, place: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return entries (B, k, k) at places (B, k), zero in the border.

        The second answer says (B,) where some lie neither in a block nor between one and the next.
        """
        band = self.main.factor.band
        lower = np.minimum(place[:, :, None], place[:, None, :])
        higher = np.maximum(place[:, :, None], place[:, None, :])
        in_band = higher < band.num_banded
        number, behind = (np.where(in_band, band.number(each), 0) for each in (lower, higher))
        out = np.zeros(lower.shape)
        for apart, of_blocks in ((0, self._within), (1, self._between)):
            asked = np.nonzero(in_band & (behind == number + apart))
            by_block = np.argsort(number[asked], kind="stable")
            asked = tuple(each[by_block] for each in asked)
            numbers = number[asked]
            for block in distinct(numbers).tolist():
                start, stop = np.searchsorted(numbers, (block, block + 1)).tolist()
                some = tuple(each[start:stop] for each in asked)
                first, last = band.starts[block], band.starts[block + apart]
                out[some] = of_blocks(block, lower[some] - first, higher[some] - last)
        return out, np.asarray((in_band & (behind > number + 1)).any(axis=(1, 2)))

    def _within(self, block: int, first: IntArray, last: IntArray) -> FloatArray:
        """Entries of Y_(i, i)."""
        return self.diagonal[block][first, last]

    def _between(self, block: int, first: IntArray, last: IntArray) -> FloatArray:
        """Entries of Y at rows of a block and columns of the next one, some (k,) of each."""
        factor, middle = self.main.factor, self.main.factor.band.middle
        outer, inner, row, column = (
            (block, block + 1, last, first) if block < middle else (block + 1, block, first, last)
        )
        rows, at = np.unique(row, return_inverse=True)
        pulled = self.main.between(inner, inner)[rows] @ across(self.below, middle, outer)
        found = pulled @ factor.pivots[outer] - self.diagonal[inner][rows] @ factor.step(outer)
        return np.asarray(found[at, column])
