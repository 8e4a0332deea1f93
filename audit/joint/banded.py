"""S where images see points of their neighbours only: block Cholesky from both ends (method.md section 11).

A video, a street or a strip of aerial photos has columns that couple within a band of width m, so that S is block
tridiagonal in some order. Its factor costs D m^2 instead of D^3, and D m numbers instead of D^2. What couples with
everything, as the parameters of a camera that all images share, is eliminated last: a border of the band.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final, TypeVar

import numpy as np
from scipy.linalg import qr

from sfm_audit.audit.joint.band import Band, band_blocks
from sfm_audit.audit.joint.lapack import (
    add_square,
    cholesky_in_place,
    divide,
    invert_triangle,
    multiply,
    square_triangle,
)
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.audit.kernels.threads import together
from sfm_audit.loaders.arrays import FloatArray

_WORTH_A_THREAD: Final = 1e7  # operations: milliseconds

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class BandedFactor:
    """X = (S + F F^T)^-1, with F one unit vector for each null direction of S, in the order of a band.

    S + F F^T = E T E^T with T block diagonal: blocks are eliminated from both ends of the band to its middle.
    pivots: P_i = T_i^-1 of each block (w_i, w_i).
    below: between the blocks i and i + 1, (w_(i+1), w_i): what `step` returns.
    null: (D, g) orthonormal G, all null directions.
    S X S = S, and S^+ = P X P with P = 1 - G G^T. No shift: where there is no such factor, None is built.
    beside: (D, m) V = [Y E; -1], with Y the inverse of the band alone, zero in the border, and E what couples them.
    corner: (m, m) K, the border's own block of X, so that X = Y + V K V^T.
    """

    band: Band
    pivots: list[FloatArray]
    below: list[FloatArray]
    null: FloatArray
    beside: FloatArray
    corner: FloatArray
    shift: float = 0.0

    def step(self, block: int) -> FloatArray:
        """U_i = A_(n, i) P_i (w_n, w_i), n the next block on the way to the middle."""
        return across(self.below, self.band.middle, block)

    def solve(self, right: FloatArray) -> FloatArray:
        """P X P right, (D, c), rows as in the matrix."""
        null, order = self.null, self.band.order
        out = self.solve_in_order(right[order] - null @ (null.T @ right[order]))
        out -= null @ (null.T @ out)
        return out[self.band.place]

    def solve_in_order(self, right: FloatArray) -> FloatArray:
        """X right, (D, c), rows by place."""
        out = self.solve_band(right)
        if self.corner.size:
            out += self.beside @ (self.corner @ (self.beside.T @ right))
        return out

    def solve_band(self, right: FloatArray) -> FloatArray:
        """Y right, (D, c), rows by place; nothing is computed where all is zero."""
        out = np.array(right, order="C")
        out[self.band.num_banded :] = 0.0
        blocks = [out[own] for own in self.band.blocks()]
        chains = self.band.chains()
        for block, following in chain(*chains):
            if blocks[block].any():
                blocks[following] -= self.step(block) @ blocks[block]
        for rows, pivot in zip(blocks, self.pivots, strict=True):
            rows[...] = pivot @ rows
        for block, following in chain(*(reversed(each) for each in chains)):
            blocks[block] -= self.step(block).T @ blocks[following]
        return out


def across(below: list[FloatArray], middle: int, block: int) -> FloatArray:
    """Of what stands below the diagonal blocks of a symmetric matrix: at a block's columns and the next one's rows."""
    return below[block] if block < middle else below[block - 1].T


def banded_factor(matrix: Symmetric, band: Band, null: FloatArray, inverse_scale: FloatArray) -> BandedFactor | None:
    """Factor S (D, D) in units of unit diagonal; None where S + F F^T is not positive definite.

    Parameters
    ----------
    null : (D, g) orthonormal, directions that S leaves free
    inverse_scale : (D,) 1 / D of each column; zero for dead ones, of which nothing but the diagonal stays

    Notes
    -----
    F: the g rows at which the null directions differ most (pivoted QR of G^T); one for each, or X were no inverse of S.
    With T_i = L_i L_i^T, C_i = A_(n, i) L_i^-T and W_i = L_i^-1: T_n -= C_i C_i^T, U_i = C_i W_i, P_i = W_i^T W_i.
    """
    _, _, diagonal, coupled, columns = band_blocks(matrix, band, inverse_scale)
    free = null[band.order]
    added = (inverse_scale == 0)[band.order].astype(np.float64)
    if free.shape[1]:
        added[qr(free.T, mode="r", pivoting=True)[1][: free.shape[1]]] += 1.0
    for square, own in zip(diagonal, band.blocks(), strict=True):
        np.einsum("ii->i", square)[...] += added[own]
    middle = diagonal[band.middle]
    for lost in both_ways(band, lambda order: _eliminate(diagonal, coupled, band.middle, order)):
        if lost is None:
            return None
        middle -= lost
    if not cholesky_in_place(middle.T):
        return None
    invert_triangle(middle.T)
    square_triangle(middle.T)
    nothing = np.zeros((len(free), 0))
    factor = BandedFactor(band, diagonal, coupled, free, nothing, nothing[:0])
    return _with_border(factor, columns, added[band.num_banded :]) if band.num_border else factor


def _eliminate(
    diagonal: list[FloatArray], below: list[FloatArray], middle: int, order: list[tuple[int, int]]
) -> FloatArray | None:
    """Leave P and U in the place of blocks on one side of the middle; what it loses by them, None without a factor."""
    lost = np.zeros_like(diagonal[middle])
    for block, following in order:
        lower, step = diagonal[block].T, across(below, middle, block)  # symmetric: LAPACK's order of the same memory
        if not cholesky_in_place(lower):
            return None
        divide(step, lower)
        to, sign = (lost, 1.0) if following == middle else (diagonal[following], -1.0)
        add_square(to.T, step, sign)
        invert_triangle(lower)
        multiply(step, lower)
        square_triangle(lower)
    return lost


def both_ways(band: Band, along: Callable[[list[tuple[int, int]]], T]) -> tuple[T, T]:
    """Go along the blocks on either side of the middle, at the same time where two threads may work.

    Parameters
    ----------
    along : of (block, next one towards the middle), from the end to the middle
    """
    chains = band.chains()
    if band.num_banded * band.width**2 < _WORTH_A_THREAD:
        return along(chains[0]), along(chains[1])
    first: list[T] = []
    second: list[T] = []
    together(lambda: first.append(along(chains[0])), lambda: second.append(along(chains[1])))
    return first[0], second[0]


def _with_border(factor: BandedFactor, columns: FloatArray, added: FloatArray) -> BandedFactor | None:
    """The factor of a band with its border, eliminated last: columns (D, m), ``added`` (m,) to the diagonal."""
    start, count = factor.band.num_banded, factor.band.num_border
    beside = factor.solve_band(columns)
    schur = columns[start:] - columns[:start].T @ beside[:start] + np.diag(added)
    lower = np.asfortranarray(0.5 * (schur + schur.T))
    if not cholesky_in_place(lower):
        return None
    beside[start:] = -np.eye(count)
    invert_triangle(lower)
    square_triangle(lower)
    return replace(factor, beside=beside, corner=np.ascontiguousarray(lower))
