"""Arrays as kernels take them: C follows indices and shapes without looking."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sfm_audit.loaders.arrays import FloatArray, IntArray

SmallIntArray: TypeAlias = NDArray[np.int32]


def ints(values: IntArray, size: int) -> IntArray:
    """Return 64-bit indices, exactly ``size`` of them."""
    out = np.ascontiguousarray(values, dtype=np.int64)
    if out.shape != (size,):
        raise ValueError(f"expected {size} indices, found shape {out.shape}")
    return out


def small_ints(values: IntArray, size: int) -> SmallIntArray:
    """Return 32-bit indices, exactly ``size`` of them; what does not fit is an error, never another index."""
    if size >= 2**31:
        raise ValueError(f"expected fewer than 2^31 observations, found {size}")
    if values.dtype != np.int32 and values.size and not (int(values.min()) >= -(2**31) and int(values.max()) < 2**31):
        raise ValueError("indices do not fit 32 bits")
    out = np.ascontiguousarray(values, dtype=np.int32)
    if out.shape != (size,):
        raise ValueError(f"expected {size} indices, found shape {out.shape}")
    return out


def doubles(values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return an array of doubles in C order, of exactly this shape."""
    out = np.ascontiguousarray(values, dtype=np.float64)
    if out.shape != shape:
        raise ValueError(f"expected an array of shape {shape}, found {out.shape}")
    return out
