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
_TRSM: Final = _bound(cython_blas, "dtrsm", 11)


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


def divided_by_factor(left: FloatArray, lower: FloatArray, *, transposed: bool) -> FloatArray:
    """Return left L^-1, or left L^-T, (m, n) in Fortran order."""
    out, size = np.array(left, dtype=np.float64, order="F"), _size_of(lower)
    if out.ndim != 2 or out.shape[1] != size.value:
        raise ValueError(f"expected (m, {size.value}), found {out.shape}")
    rows, one = _Integer(len(out)), ctypes.c_double(1.0)
    shape = rows, size, one, lower, _at_least_one(size), out, _at_least_one(rows)
    _call(_TRSM, _RIGHT, _LOWER, _TRANSPOSED if transposed else _PLAIN, _PLAIN, *shape)
    return out


def _call(function: Callable[..., None], *arguments: Any) -> None:
    """Call with the addresses of arrays and of ctypes' numbers."""
    addresses = [each.ctypes.data if isinstance(each, np.ndarray) else ctypes.addressof(each) for each in arguments]
    function(*addresses)


def _size_of(matrix: FloatArray) -> _Number:
    """The size of a square matrix that LAPACK can take as it lies in memory."""
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"expected a square matrix, found {matrix.shape}")
    if matrix.dtype != np.float64 or not matrix.flags.f_contiguous or not matrix.flags.writeable:
        raise ValueError("expected 64-bit numbers in Fortran order that may be written")
    return _Integer(len(matrix))


def _at_least_one(size: _Number) -> _Number:
    return _Integer(max(1, size.value))
