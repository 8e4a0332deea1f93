"""S^+ M S^+ near the diagonal, where S and M are banded: one sweep forward, one back (method.md section 11)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack

from sfm_audit.audit.joint.banded import BandedFactor, BandedInverse
from sfm_audit.loaders.arrays import FloatArray, IntArray


def banded_sandwiches(
    main: BandedInverse, meat: sparse.csr_array, blocks: Sequence[IntArray]
) -> list[FloatArray | None]:
    """Return S^+ M S^+ at each block of columns (k,); None of those that span more than two blocks of the band.

    Notes
    -----
    S^+ M S^+ = P X M X P: scores are off the points, track by track, so that M has the null directions of S, M G = 0.
    With E T E^T block diagonal by eliminating block after block (T = X^-1, U_i as in `banded_inverse`), M follows:
    N_i = M_(i+1, i) - U_i M_(i, i),  M_(i+1, i+1) -= U_i M_(i, i+1) + N_i U_i^T. Then back, Y = X M X, D_i = T_i^-1:
    Y_(i, i+1) = D_i N_i^T X_(i+1, i+1) - U_i^T Y_(i+1, i+1),
    Y_(i, i) = D_i M_(i, i) D_i - Y_(i, i+1) U_i - U_i^T X_(i+1, i+1) N_i D_i.
    All this is of the band; with X + V K V^T in the place of X and Q = (X + V K V^T) M V, the border adds
    B V^T + V B^T, B = Q K - V K V^T M V K / 2.
    """
    factor, band, null, scale = main.factor, main.factor.band, main.factor.null, main.inverse_scale
    scaled = sparse.csr_array(sparse.diags_array(scale) @ meat @ sparse.diags_array(scale))
    ordered = sparse.csr_array(scaled[band.order][:, band.order])
    near = _near(main, ordered)
    pulled = factor.solve_in_order(ordered @ factor.solve_in_order(null))
    pull = pulled - 0.5 * null @ (null.T @ pulled)  # P Y P = Y - G H^T - H G^T
    aside, pull = main.aside, np.hstack([pull, -_of_border(factor, ordered)])
    out: list[FloatArray | None] = []
    for block in blocks:
        place = band.place[block]
        inner = place < band.num_banded
        number = band.number(place[inner])
        first = int(number.min()) if number.size else 0
        if number.size and number.max() - first > 1:
            out.append(None)
            continue
        outer = aside[place] @ pull[place].T
        values = -outer - outer.T
        values[np.ix_(inner, inner)] += _entries(near, place[inner], int(band.starts[first]), first)
        out.append(values * scale[block] * scale[block][:, None])
    return out


def _of_border(factor: BandedFactor, meat: sparse.csr_array) -> FloatArray:
    """B (D, m) by place: what the border adds to the sandwich of the band alone is B V^T + V B^T."""
    beside, corner = factor.beside, factor.corner
    if not corner.size:
        return beside
    weighed = meat @ beside
    inner = corner @ (beside.T @ weighed) @ corner
    return np.asarray(factor.solve_in_order(weighed) @ corner - 0.5 * beside @ inner)


def _entries(near: list[FloatArray], place: IntArray, origin: int, first: int) -> FloatArray:
    """Entries of Y at some places within block ``first`` and the next one."""
    out = np.empty((place.size, place.size))
    width = near[first].shape[0] if place.size else 0
    local = place - origin
    here, there = np.flatnonzero(local < width), np.flatnonzero(local >= width)
    out[np.ix_(here, here)] = near[first][np.ix_(local[here], local[here])] if here.size else 0.0
    if there.size:
        beside = near[first][np.ix_(local[here], local[there])]
        out[np.ix_(here, there)], out[np.ix_(there, here)] = beside, beside.T
        out[np.ix_(there, there)] = near[first + 1][np.ix_(local[there] - width, local[there] - width)]
    return out


def _near(main: BandedInverse, meat: sparse.csr_array) -> list[FloatArray]:
    """Per block i, [Y_(i, i), Y_(i, i+1)]."""
    factor, blocks = main.factor, list(main.factor.band.blocks())
    eliminated, coupled, multipliers = [meat[blocks[0], blocks[0]].toarray()], [], []
    for i, own in enumerate(blocks[:-1]):
        following = blocks[i + 1]
        u = np.asarray(blas.dtrsm(1.0, factor.diagonal[i], factor.below[i], side=1, lower=1))
        across = meat[following, own].toarray()
        n = across - u @ eliminated[i]
        eliminated.append(meat[following, following].toarray() - u @ across.T - n @ u.T)
        coupled.append(n)
        multipliers.append(u)
    out: list[FloatArray] = []
    for i in range(len(blocks) - 1, -1, -1):
        pivot, _ = lapack.dpotri(factor.diagonal[i], lower=1)
        pivot = np.tril(pivot) + np.tril(pivot, -1).T
        y = pivot @ eliminated[i] @ pivot
        if i + 1 == len(blocks):
            out.append(y)
            continue
        size = len(multipliers[i])
        moved = main.near[i + 1][:, :size] @ coupled[i] @ pivot  # X_(i+1, i+1) N_i D_i
        beside = moved.T - multipliers[i].T @ out[-1][:, :size]
        out.append(np.hstack([y - beside @ multipliers[i] - multipliers[i].T @ moved, beside]))
    return out[::-1]
