"""S^+ M S^+ near the diagonal, where S and M are banded: one sweep forward, one back (method.md section 11)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sfm_audit.audit.joint.band import BandBlocks, band_blocks
from sfm_audit.audit.joint.banded import BandedFactor, BandedInverse
from sfm_audit.audit.joint.lapack import divided_by_factor, inverse_of_factor
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.loaders.arrays import FloatArray, IntArray


def banded_sandwiches(main: BandedInverse, meat: Symmetric, blocks: Sequence[IntArray]) -> list[FloatArray | None]:
    """Return S^+ M S^+ at each block of columns (k,); None of those that span more than two blocks of the band.

    Notes
    -----
    S^+ M S^+ = P X M X P: scores are off the points, track by track, so that M has the null directions of S, M G = 0.
    With E T E^T block diagonal by eliminating block after block (T = X^-1, U_i as in `banded_inverse`), M follows:
    N_i = M_(i+1, i) - U_i M_(i, i),  M_(i+1, i+1) -= H_i + H_i^T,  H_i = U_i (M_(i+1, i) - U_i M_(i, i) / 2)^T.
    Then back, Y = X M X, D_i = T_i^-1, with B_i = X_(i+1, i+1) N_i D_i and V_i = Y_(i+1, i+1) U_i:
    Y_(i, i+1) = (B_i - V_i)^T,  Y_(i, i) = D_i M_(i, i) D_i - H_i - H_i^T,  H_i = U_i^T (B_i - V_i / 2).
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
    factor, diagonal, below, multipliers = main.factor, meat.diagonal, meat.below, []
    for i, across in enumerate(below):
        u = divided_by_factor(factor.below[i], factor.diagonal[i], transposed=False)
        moved = u @ diagonal[i]
        half = u @ (across - 0.5 * moved).T
        diagonal[i + 1] -= half + half.T
        below[i] -= moved
        multipliers.append(u)
    for i in range(len(diagonal) - 1, -1, -1):
        pivot = inverse_of_factor(factor.diagonal[i])
        pivot = np.tril(pivot) + np.tril(pivot, -1).T
        diagonal[i][...] = pivot @ diagonal[i] @ pivot
        if i < len(below):
            u = multipliers.pop()  # what was used is given back
            moved = main.near[i + 1][:, : len(u)] @ (below[i] @ pivot)
            after = diagonal[i + 1] @ u
            half = u.T @ (moved - 0.5 * after)
            diagonal[i] -= half + half.T
            np.subtract(moved, after, out=below[i])
    return meat
