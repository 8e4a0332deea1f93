"""S^+ where images see points of their neighbours only: block Cholesky and the selected inverse (method.md section 11).

A video, a street or a strip of aerial photos has columns that couple within a band of width m, so that S is block
tridiagonal in some order. Its factor costs D m^2 instead of D^3, and D m numbers instead of D^2. What couples with
everything, as the parameters of a camera that all images share, is eliminated last: a border of the band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.linalg import qr

from sfm_audit.audit.joint.band import Band, band_blocks, in_blocks
from sfm_audit.audit.joint.lapack import cholesky_in_place, divided_by_factor, inverse_of_factor
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.audit.kernels.joint_parts import near_entries
from sfm_audit.audit.kernels.joint_scores import BandArrays
from sfm_audit.loaders.arrays import FloatArray, IntArray

_REACH: Final = 3  # blocks of the inverse beside the diagonal one that are kept: all that an image's neighbours span


@dataclass(frozen=True, slots=True, eq=False)
class BandedFactor:
    """X = (S + F F^T)^-1, with F one unit vector for each null direction of S, in the order of a band.

    diagonal: L_i of each block, in the lower triangle.    below: C_i = A_(i+1, i) L_i^-T.
    null: (D, g) orthonormal G, all null directions.
    S X S = S, and S^+ = P X P with P = 1 - G G^T. No shift: where there is no such factor, None is built.
    beside: (D, m) V = [Y E; -1], with Y the inverse of the band alone, zero in the border, and E what couples them.
    corner: (m, m) K, the border's own block of X, so that X = Y + V K V^T.
    """

    band: Band
    diagonal: list[FloatArray]
    below: list[FloatArray]
    null: FloatArray
    beside: FloatArray
    corner: FloatArray
    shift: float = 0.0

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
        """Y right, (D, c), rows by place; nothing is computed above the first row that is not zero."""
        out = np.array(right, order="C")
        out[self.band.num_banded :] = 0.0
        blocks = list(self.band.blocks())
        first = int(self.band.number(np.array([np.argmax(out.any(axis=1))]))[0])
        for i in range(first, len(blocks)):
            if i > first:
                out[blocks[i]] -= self.below[i - 1] @ out[blocks[i - 1]]
            out[blocks[i]] = _triangular(self.diagonal[i], out[blocks[i]], transposed=False)
        for i in range(len(blocks) - 1, -1, -1):
            if i + 1 < len(blocks):
                out[blocks[i]] -= self.below[i].T @ out[blocks[i + 1]]
            out[blocks[i]] = _triangular(self.diagonal[i], out[blocks[i]], transposed=True)
        return out


def _triangular(lower: FloatArray, right: FloatArray, *, transposed: bool) -> FloatArray:
    """L^-1 right, or L^-T right; as right^T L^-T or right^T L^-1, so that rows in C order need no copy for BLAS."""
    return divided_by_factor(right.T, lower, transposed=not transposed).T


def banded_factor(matrix: Symmetric, band: Band, null: FloatArray, inverse_scale: FloatArray) -> BandedFactor | None:
    """Factor S (D, D) in units of unit diagonal; None where S + F F^T is not positive definite.

    Parameters
    ----------
    null : (D, g) orthonormal, directions that S leaves free
    inverse_scale : (D,) 1 / D of each column; zero for dead ones, of which nothing but the diagonal stays

    Notes
    -----
    F: the g rows at which the null directions differ most (pivoted QR of G^T); one for each, or X were no inverse of S.
    """
    _, _, diagonal, coupled, columns = band_blocks(matrix, band, inverse_scale)
    free = null[band.order]
    added = (inverse_scale == 0)[band.order].astype(np.float64)
    if free.shape[1]:
        added[qr(free.T, mode="r", pivoting=True)[1][: free.shape[1]]] += 1.0
    below: list[FloatArray] = []
    for i, own in enumerate(band.blocks()):
        block = diagonal[i]
        np.einsum("ii->i", block)[...] += added[own]
        if i:
            block -= below[-1] @ below[-1].T
        lower = diagonal[i] = block.T  # symmetric: in its own memory
        if not cholesky_in_place(lower):
            return None
        if i < len(coupled):
            below.append(np.ascontiguousarray(_triangular(lower, coupled[i].T, transposed=False).T))
    nothing = np.zeros((len(free), 0))
    factor = BandedFactor(band, diagonal, below, free, nothing, nothing[:0])
    return _with_border(factor, columns, added[band.num_banded :]) if band.num_border else factor


def _with_border(factor: BandedFactor, columns: FloatArray, added: FloatArray) -> BandedFactor | None:
    """The factor of a band with its border, eliminated last: columns (D, m), ``added`` (m,) to the diagonal."""
    start, count = factor.band.num_banded, factor.band.num_border
    beside = factor.solve_band(columns)
    schur = columns[start:] - columns[:start].T @ beside[:start] + np.diag(added)
    lower = np.asfortranarray(0.5 * (schur + schur.T))
    if not cholesky_in_place(lower):
        return None
    beside[start:] = -np.eye(count)
    root = _triangular(lower, np.eye(count), transposed=False)
    return replace(factor, beside=beside, corner=root.T @ root)


@dataclass(frozen=True, slots=True, eq=False)
class BandedInverse:
    """S^+ = D^-1 P X P D^-1 = D^-1 (Y - A B^T - B A^T) D^-1, of which the blocks near the diagonal are at hand.

    near: per block i, the entries of Y at its rows and at the columns of the blocks i .. i + 3; views of ``flat``,
    where one follows the other. Zero in the border.
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

    def arrays(self) -> BandArrays:
        """As compiled sums take it."""
        band, starts = self.factor.band, _places_in_flat(self.near)
        outer = self.aside, self.pull
        return BandArrays(band.place, band.starts, self.flat, *starts, *outer, self.inverse_scale)

    def _is_near(self, columns: IntArray) -> bool:
        """Whether all entries at some columns are at hand."""
        place, band = self.factor.band.place[columns], self.factor.band
        number = band.number(place[place < band.num_banded])
        return not number.size or int(number.max() - number.min()) <= _REACH

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
    From the last block to the first, with U_i = C_i L_i^-1: X_(i, j) = -U_i^T X_(i+1, j) for j > i, and
    X_(i, i) = (L_i L_i^T)^-1 - X_(i, i+1) U_i.
    """
    starts = factor.band.starts.tolist()
    ends_of_reach = [*starts[_REACH + 1 :], *[starts[-1]] * _REACH]
    shapes = [
        (own.stop - own.start, end - own.start) for own, end in zip(factor.band.blocks(), ends_of_reach, strict=False)
    ]
    flat = np.empty(sum(rows * columns for rows, columns in shapes))
    near = in_blocks(flat, shapes)
    for i in range(len(factor.diagonal) - 1, -1, -1):
        own = inverse_of_factor(factor.diagonal[i])
        own = np.tril(own) + np.tril(own, -1).T
        if i + 1 == len(near):
            near[i][...] = own
            continue
        u = _triangular(factor.diagonal[i], factor.below[i].T, transposed=True).T
        beside = -u.T @ near[i + 1][:, : near[i].shape[1] - len(own)]
        own -= beside[:, : len(u)] @ u
        near[i][:, : len(own)], near[i][:, len(own) :] = 0.5 * (own + own.T), beside
    null = factor.null
    pulled = factor.solve_in_order(null)
    pull = np.hstack([pulled - 0.5 * null @ (null.T @ pulled), -0.5 * factor.beside @ factor.corner])
    return BandedInverse(factor, flat, near, np.hstack([null, factor.beside]), pull, inverse_scale)
