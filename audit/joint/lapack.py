"""Cholesky factors and triangular solves of LAPACK and BLAS, without Python's lock.

`scipy.linalg.lapack` and `scipy.linalg.blas` keep the lock while they compute: two threads that each have a block of a
large model would wait for one another, and so would whoever works beside the joint step. These are the same functions,
by the pointers that SciPy hands to compiled code (`scipy.linalg.cython_lapack`, `scipy.linalg.cython_blas`).
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from typing import Any, Final, TypeAlias

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from sfm_audit.loaders.arrays import FloatArray

# Whole numbers of SciPy's LAPACK have 32 bits, in some builds from 1.18 on 64. Where the low bits come first, the
# address of a small number of 64 bits serves both.
_Number: TypeAlias = ctypes.c_int64 | ctypes.c_int
_Integer: Final[type[_Number]] = ctypes.c_int64 if sys.byteorder == "little" else ctypes.c_int
_LOWER, _PLAIN, _TRANSPOSED, _RIGHT = (ctypes.c_char(letter) for letter in (b"L", b"N", b"T", b"R"))
_LEFT, _ONE, _LESS = _LOWER, ctypes.c_double(1.0), ctypes.c_double(-1.0)
_SMALL: Final = 128  # columns up to which LAPACK's inverse of a triangle is not slower than products of its parts


_AT_ONCE: Final = 64
_ABOVE: Final = np.triu(np.ones((_AT_ONCE, _AT_ONCE), dtype=bool), 1)
_name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def _bound(module: Any, name: str, num_arguments: int) -> Callable[..., None]:
    """Return a function that takes the addresses of its arguments; ctypes gives the lock away for it."""
    capsule = module.__pyx_capi__[name]
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * num_arguments)
    function: Callable[..., None] = kind(_address_of(capsule, _name_of(capsule)))
    return function


_POTRF: Final = _bound(cython_lapack, "dpotrf", 5)
_POTRI: Final = _bound(cython_lapack, "dpotri", 5)
_POTRS: Final = _bound(cython_lapack, "dpotrs", 8)
_LAUUM: Final = _bound(cython_lapack, "dlauum", 5)
_TRTRI: Final = _bound(cython_lapack, "dtrtri", 6)
_TRSM: Final = _bound(cython_blas, "dtrsm", 11)
_TRMM: Final = _bound(cython_blas, "dtrmm", 11)
_GEMM: Final = _bound(cython_blas, "dgemm", 13)
_SYRK: Final = _bound(cython_blas, "dsyrk", 10)
_SYR2K: Final = _bound(cython_blas, "dsyr2k", 12)


def cholesky_in_place(matrix: FloatArray) -> bool:
    """Put L of matrix = L L^T into the lower triangle (n, n); return whether there is one. Fortran order.

    What stands above the diagonal stays, and is of no meaning to the functions of this module.
    """
    size, info = _size_of(matrix), _Integer(0)
    _call(_POTRF, _LOWER, size, matrix, _at_least_one(size), info)
    return info.value == 0


def inverse_of_factor(lower: FloatArray, *, in_place: bool = False) -> FloatArray:
    """Return the lower triangle of (L L^T)^-1 (n, n), above it what was there; Fortran order."""
    out = lower if in_place else np.array(lower, order="F")
    size, info = _size_of(out), _Integer(0)
    _call(_POTRI, _LOWER, size, out, _at_least_one(size), info)
    return out


def solve_by_factor(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Return (L L^T)^-1 right, (n, c) in Fortran order."""
    out, info = np.array(right, dtype=np.float64, order="F"), _Integer(0)
    size = _size_of(lower)
    if out.ndim != 2 or len(out) != size.value:
        raise ValueError(f"expected ({size.value}, c) right sides, found {out.shape}")
    rows = _at_least_one(size)
    _call(_POTRS, _LOWER, size, _Integer(out.shape[1]), lower, rows, out, rows, info)
    return out


def divide(matrix: FloatArray, lower: FloatArray) -> None:
    """Turn a matrix (m, n) into matrix L^-T, in place."""
    _triangular(_TRSM, matrix, lower, _TRANSPOSED, _PLAIN)


def multiply(matrix: FloatArray, lower: FloatArray) -> None:
    """Turn a matrix (m, n) into matrix L, in place."""
    _triangular(_TRMM, matrix, lower, _PLAIN, _TRANSPOSED)


def _triangular(
    function: Callable[..., None], matrix: FloatArray, lower: FloatArray, right: ctypes.c_char, left: ctypes.c_char
) -> None:
    """By L from the right, or, of rows in C order, by L transposed from the left."""
    (m, n), (turned, rows), (lower_turned, lower_rows) = matrix.shape, _lies(matrix), _lies(lower)
    if lower.shape != (n, n) or lower_turned:
        raise ValueError(f"expected a factor ({n}, {n}) in Fortran order, found {lower.shape}")
    side, trans, shape = (_LEFT, left, (n, m)) if turned else (_RIGHT, right, (m, n))
    _call(function, side, _LOWER, trans, _PLAIN, *map(_Integer, shape), _ONE, lower, lower_rows, matrix, rows)


def invert_triangle(lower: FloatArray) -> None:
    """Turn the lower triangle of L (n, n) into that of L^-1, in place; Fortran order, above the diagonal all stays."""
    size, (turned, rows) = len(lower), _lies(lower)
    if lower.shape != (size, size) or turned:
        raise ValueError(f"expected a factor in Fortran order, found {lower.shape}")
    if size <= _SMALL:
        _call(_TRTRI, _LOWER, _PLAIN, _Integer(size), lower, rows, _Integer(0))
        return
    half = size // 2
    first, last, across = lower[:half, :half], lower[half:, half:], lower[half:, :half]
    invert_triangle(first)
    invert_triangle(last)
    shape = _Integer(size - half), _Integer(half)
    _call(_TRMM, _LEFT, _LOWER, _PLAIN, _PLAIN, *shape, _LESS, last, rows, across, rows)
    _call(_TRMM, _RIGHT, _LOWER, _PLAIN, _PLAIN, *shape, _ONE, first, rows, across, rows)


def square_triangle(lower: FloatArray) -> None:
    """Turn the lower triangle of L (n, n) into L^T L, all of it, in place; Fortran order."""
    size = _size_of(lower)
    _call(_LAUUM, _LOWER, size, lower, _at_least_one(size), _Integer(0))
    mirror(lower)


def mirror(matrix: FloatArray) -> None:
    """Put what stands below the diagonal of a square matrix above it."""
    size = len(matrix)
    for start in range(0, size, _AT_ONCE):
        stop = min(start + _AT_ONCE, size)
        square = matrix[start:stop, start:stop]
        np.copyto(square, square.T.copy(), where=_ABOVE[: stop - start, : stop - start])
        matrix[start:stop, stop:] = matrix[stop:, start:stop].T


def add_product(out: FloatArray, left: FloatArray, right: FloatArray, factor: float = 1.0, keep: float = 1.0) -> None:
    """Turn out (m, n) into keep out + factor left right, (m, k) and (k, n)."""
    if left.shape[1] != len(right) or out.shape != (len(left), right.shape[1]):
        raise ValueError(f"expected {out.shape}, found {left.shape} times {right.shape}")
    if _lies(out)[0]:
        out, left, right = out.T, right.T, left.T
    (left_trans, left_rows), (right_trans, right_rows) = _as_given(left), _as_given(right)
    shape = map(_Integer, (*out.shape, left.shape[1]))
    given = ctypes.c_double(factor), left, left_rows, right, right_rows, ctypes.c_double(keep)
    _call(_GEMM, left_trans, right_trans, *shape, *given, out, _lies(out)[1])


def add_square(out: FloatArray, left: FloatArray, factor: float = 1.0) -> None:
    """Add factor left left^T, of (n, k), to the lower triangle of out (n, n) in Fortran order."""
    turned, rows = _lies(out)
    if out.shape != (len(left), len(left)) or turned:
        raise ValueError(f"expected ({len(left)}, {len(left)}) in Fortran order, found {out.shape}")
    trans, left_rows = _as_given(left)
    shape = _Integer(len(out)), _Integer(left.shape[1])
    _call(_SYRK, _LOWER, trans, *shape, ctypes.c_double(factor), left, left_rows, _ONE, out, rows)


def add_both(out: FloatArray, left: FloatArray, right: FloatArray, factor: float = 1.0, keep: float = 1.0) -> None:
    """Turn the lower triangle of out (n, n) in Fortran order into keep out + factor (left right^T + right left^T).

    Parameters
    ----------
    left, right : (n, k), in the same order
    """
    turned, rows = _lies(out)
    (trans, left_rows), (right_trans, right_rows) = _as_given(left), _as_given(right)
    size = len(left)
    if not out.shape == (size, size) or left.shape != right.shape or turned or trans.value != right_trans.value:
        raise ValueError(f"expected ({size}, {size}) and two alike, found {out.shape}, {left.shape}, {right.shape}")
    shape = _Integer(size), _Integer(left.shape[1])
    given = ctypes.c_double(factor), left, left_rows, right, right_rows, ctypes.c_double(keep)
    _call(_SYR2K, _LOWER, trans, *shape, *given, out, rows)


def _lies(matrix: FloatArray) -> tuple[bool, _Number]:
    """Whether BLAS would see the transpose of a matrix; how far its columns are apart, or its rows where it would."""
    (rows, columns), (down, beside), size = matrix.shape, matrix.strides, matrix.itemsize
    if matrix.dtype == np.float64 and matrix.flags.writeable and matrix.flags.aligned:
        least = size * max(rows, columns, 1)  # of a single row or column, and where there is nothing
        if (rows <= 1 or down == size) and (columns <= 1 or beside >= size * rows) and beside % size == 0:
            return False, _Integer((beside if columns > 1 and matrix.size else least) // size)
        if (columns <= 1 or beside == size) and (rows <= 1 or down >= size * columns) and down % size == 0:
            return True, _Integer((down if rows > 1 and matrix.size else least) // size)
        if not matrix.size:
            return False, _Integer(least // size)
    raise ValueError("expected 64-bit numbers, rows or columns without gaps, that may be written")


def _as_given(matrix: FloatArray) -> tuple[ctypes.c_char, _Number]:
    """How BLAS is told to take a matrix as it is."""
    turned, rows = _lies(matrix)
    return (_TRANSPOSED if turned else _PLAIN), rows


def _call(function: Callable[..., None], *arguments: Any) -> None:
    """Call with the addresses of arrays and of ctypes' numbers."""
    function(*(each.ctypes.data if isinstance(each, np.ndarray) else ctypes.addressof(each) for each in arguments))


def _size_of(matrix: FloatArray) -> _Number:
    """The size of a square matrix that LAPACK can take as it lies in memory."""
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"expected a square matrix, found {matrix.shape}")
    if matrix.dtype != np.float64 or not matrix.flags.f_contiguous or not matrix.flags.writeable:
        raise ValueError("expected 64-bit numbers in Fortran order that may be written")
    return _Integer(len(matrix))


def _at_least_one(size: _Number) -> _Number:
    return _Integer(max(1, size.value))
