"""Orthonormal bases of a few long columns: exactly, or through their Gram matrix where that is as good.

Columns are rows of (c, m) arrays here (m = 2n values each), so that every product runs along memory.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.linalg.blas import dgemm

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

NUISANCE_THRESHOLD: Final = 1e-9  # of the largest singular value (method.md section 5, step 1)
FIELD_THRESHOLD: Final = 1e-6  # of the largest singular value before projection
MAX_LEVERAGE: Final = 1.0 - 1e-9
SMALLEST_PIVOT: Final = 1e-10  # of a Gram matrix of unit columns: below it, the exact path
SURE_FIELD: Final = 1e-10  # squared singular values above this share of the largest are kept with eight digits ..
SURE_NULL: Final = 1e-14  # .. those below this one are rounding; in between, the exact path decides
SAFE_SQUARE: Final = 1e-280  # sums of squares between this and its inverse lost nothing to under- or overflow
MODEST_SQUARE: Final = 1e-60  # the same for squares that are multiplied with each other and with those of residuals


def unit_columns(columns: FloatArray) -> FloatArray:
    """Return the columns (c, m) that are not zero, scaled to unit length; columns that are not finite become NaN."""
    norms = column_norms(columns)
    kept = norms != 0
    if not kept.all():
        columns, norms = columns[kept], norms[kept]
    return np.asarray(columns / norms[:, None], dtype=np.float64)


def column_norms(columns: FloatArray) -> FloatArray:
    """Return the lengths of the columns (c, m), without overflow; NaN where a column is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.einsum("cm,cm->c", columns, columns)
        if _within(squares, SAFE_SQUARE):
            return np.asarray(np.sqrt(squares))
        largest = np.abs(columns).max(axis=1, initial=0.0)
        divisor = np.where(largest > 0, largest, 1.0)
        return np.asarray(divisor * np.sqrt(np.sum((columns / divisor[:, None]) ** 2, axis=1)))


def may_stay_unscaled(sq_norms: FloatArray) -> bool:
    """Whether products of fields of these squared lengths with each other and with residuals cannot overflow."""
    return _within(sq_norms, MODEST_SQUARE)


def _within(values: FloatArray, smallest: float) -> bool:
    return bool(((values > smallest) & (values < 1.0 / smallest)).all())


def exact_basis(columns: FloatArray, threshold: float) -> FloatArray:
    """Return (r, m): left singular vectors of the columns (c, m) whose singular value exceeds ``threshold``.

    By QR and the singular values of its triangle, which is as accurate as the singular values of the columns.
    """
    orthogonal, triangle = np.linalg.qr(columns.T)
    vectors, singular, _ = np.linalg.svd(triangle)
    return np.ascontiguousarray((orthogonal @ vectors[:, : singular.size][:, singular > threshold]).T)


def nuisance_basis(columns: FloatArray, *, exact: bool = False) -> FloatArray:
    """Return Q, (q', m): an orthonormal basis of unit columns (q, m) with method.md's threshold.

    The Gram path orthonormalises twice, so that Q is orthonormal to rounding wherever the path is taken.
    """
    if not len(columns):
        return columns
    if not exact:
        values, vectors = np.linalg.eigh(columns @ columns.T)
        if values[0] > SMALLEST_PIVOT * values[-1]:
            basis = (vectors / np.sqrt(values)).T @ columns
            values, vectors = np.linalg.eigh(basis @ basis.T)
            return np.asarray((vectors / np.sqrt(values)).T @ basis, dtype=np.float64)
    largest = np.linalg.svd(np.linalg.qr(columns.T, mode="r"), compute_uv=False)[0]
    return exact_basis(columns, NUISANCE_THRESHOLD * largest)


def nuisance_bases(columns: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the images whose columns have full rank beyond doubt, and the `nuisance_basis` of these, (.., q, m).

    Parameters
    ----------
    columns : (B, q, m) of each image, of any length
    """
    squares = np.einsum("bcm,bcm->bc", columns, columns)
    usual = np.flatnonzero(in_range(squares))
    unit = columns[usual] / np.sqrt(squares[usual])[:, :, None]
    values, vectors = np.linalg.eigh(unit @ unit.swapaxes(1, 2))
    sure = values[:, 0] > SMALLEST_PIVOT * values[:, -1]
    q = _orthonormal(vectors[sure], values[sure], unit[sure])
    values, vectors = np.linalg.eigh(q @ q.swapaxes(1, 2))  # again: orthonormal to rounding
    return usual[sure].astype(np.int64), _orthonormal(vectors, values, q)


def in_range(squares: FloatArray, smallest: float = SAFE_SQUARE) -> BoolArray:
    """(B,) whether all of (B, c) sums of squares are in the range in which nothing is lost."""
    return np.asarray(((squares > smallest) & (squares < 1.0 / smallest)).all(axis=1))


def _orthonormal(vectors: FloatArray, values: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray((vectors / np.sqrt(values)[:, None]).swapaxes(1, 2) @ columns)


def project_off(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Return columns (..., m) minus their projections on an orthonormal basis (q, m)."""
    return np.asarray(columns - (columns @ basis.T) @ basis, dtype=np.float64)


def project_off_in_place(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Project columns (c, m), in C order, off an orthonormal basis (q, m), in place; return their coordinates on it."""
    if not columns.flags.c_contiguous:
        raise ValueError("columns to project in place must be in C order")
    coordinates = columns @ basis.T
    if columns.size and basis.size:  # BLAS subtracts where they stand: fresh memory is dearer than arithmetic
        dgemm(-1.0, basis.T, coordinates.T, 1.0, columns.T, overwrite_c=1)
    return np.asarray(coordinates)


def field_transform(gram: FloatArray, before: FloatArray) -> FloatArray | None:
    """Return W, (c, r), such that W^T E is orthonormal, from E's Gram matrix (c, c) after projection.

    Parameters
    ----------
    before : Gram matrix (c, c) of E *before* projection

    Returns
    -------
    FloatArray or None
        None where the Gram matrix cannot tell which directions exceed `FIELD_THRESHOLD`.
    """
    values, vectors = np.linalg.eigh(gram)
    upper = float(before.trace())  # the largest squared singular value lies between this / c and this
    kept = values > SURE_FIELD * upper
    if (values[~kept] > SURE_NULL * upper / len(values)).any():
        largest = largest_sq(before)
        kept = values > SURE_FIELD * largest
        if (values[~kept] > SURE_NULL * largest).any():
            return None
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]), dtype=np.float64)


def largest_sq(gram: FloatArray) -> float:
    """Return the largest squared singular value of the columns that have this Gram matrix."""
    return float(np.linalg.eigvalsh(gram)[-1])
