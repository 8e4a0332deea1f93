"""S^+ M S^+ near the diagonal, where S and M are banded: one sweep forward, one back (method.md section 11)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sfm_audit.audit.joint.band import BandBlocks, band_blocks
from sfm_audit.audit.joint.banded import BandedFactor, across, both_ways
from sfm_audit.audit.joint.banded_inverse import BandedInverse
from sfm_audit.audit.joint.lapack import add_both, add_product, mirror, multiply
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.loaders.arrays import FloatArray, IntArray


def banded_sandwiches(main: BandedInverse, meat: Symmetric, blocks: Sequence[IntArray]) -> list[FloatArray | None]:
    """Return S^+ M S^+ at each block of columns (k,); None of those that span more than two blocks of the band.

    Notes
    -----
    S^+ M S^+ = P X M X P: scores are off the points, track by track, so that M has the null directions of S, M G = 0.
    As block after block is eliminated (U_i, P_i and n, the next block, as in `BandedFactor`), M follows:
    N_i = M_(n, i) - U_i M_(i, i),  M_(n, n) -= H_i + H_i^T,  H_i = U_i (M_(n, i) - U_i M_(i, i) / 2)^T.
    Then back, Y = X M X, with B_i = X_(n, n) N_i P_i and V_i = Y_(n, n) U_i:
    Y_(n, i) = B_i - V_i,  Y_(i, i) = P_i M_(i, i) P_i - H_i - H_i^T,  H_i = U_i^T (B_i - V_i / 2).
    All this is of the band; with X + V K V^T in the place of X and Q = (X + V K V^T) M V, the border adds
    B V^T + V B^T, B = Q K - V K V^T M V K / 2.
    """
    factor, band, null, scale = main.factor, main.factor.band, main.factor.null, main.inverse_scale

    def times(values: FloatArray) -> FloatArray:
        """The meat in scaled units times (D, c), by place."""
        return ((meat @ (values[band.place] * scale[:, None])) * scale[:, None])[band.order]

    near = _near(main, band_blocks(meat, band, scale))
    pulled = factor.solve_in_order(times(factor.solve_in_order(null)))
    pull = pulled - 0.5 * null @ (null.T @ pulled)  # P Y P = Y - G H^T - H G^T
    aside, pull = main.aside, np.hstack([pull, -_of_border(factor, times)])
    out: list[FloatArray | None] = [None] * len(blocks)
    for size in {block.size for block in blocks}:
        numbers = [k for k, block in enumerate(blocks) if block.size == size]
        columns = np.stack([blocks[k] for k in numbers])
        place = band.place[columns]
        values, too_far = near.at(band, place)
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


def _near(main: BandedInverse, meat: BandBlocks) -> BandBlocks:
    """Y_(i, i) and Y_(i+1, i) of each block i, in the memory of the meat; its border stays."""
    factor, band, diagonal = main.factor, main.factor.band, meat.diagonal
    middle = band.middle

    def inwards(order: list[tuple[int, int]]) -> FloatArray:
        """What the middle loses by the blocks on one side of it."""
        lost = np.zeros_like(diagonal[middle])
        for block, following in order:
            step, beside = factor.step(block), across(meat.below, middle, block)
            half = beside.copy(order="K")
            mirror(diagonal[block].T)
            add_product(half, step, diagonal[block], -0.5)
            to, sign = (lost, 1.0) if following == middle else (diagonal[following], -1.0)
            add_both(to.T, step, half, sign)
            np.subtract(half, beside, out=beside)
            beside += half
        return lost

    def outwards(order: list[tuple[int, int]]) -> None:
        for block, following in reversed(order):
            step, beside, own = factor.step(block), across(meat.below, middle, block), diagonal[block]
            _between(own, factor.pivots[block])
            moved, after = np.empty_like(step), np.empty_like(step)
            add_product(after, beside, factor.pivots[block], keep=0.0)
            add_product(moved, main.near[following][:, : len(step)], after, keep=0.0)
            add_product(after, diagonal[following], step, 0.5, keep=0.0)
            moved -= after
            np.subtract(moved, after, out=beside)
            add_both(own.T, step.T, moved.T, -1.0)
            mirror(own.T)

    for lost in both_ways(band, inwards):
        diagonal[middle] -= lost
    mirror(diagonal[middle].T)
    _between(diagonal[middle], factor.pivots[middle])
    mirror(diagonal[middle].T)
    both_ways(band, outwards)
    return meat


def _between(own: FloatArray, pivot: FloatArray) -> None:
    """Turn M into the lower triangle, in Fortran order, of P M P; of M that triangle is taken.

    With K the triangle and half the diagonal: (P K) P + P (P K)^T.
    """
    lower = own.T
    np.einsum("ii->i", lower)[...] *= 0.5
    half = pivot.copy()
    multiply(half, lower)
    add_both(lower, half, pivot, keep=0.0)
