"""Arrays as kernels take them: C follows indices and shapes without looking."""

from __future__ import annotations

import math
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

SmallIntArray: TypeAlias = NDArray[np.int32]
_LINE: Final = 8  # doubles


def ints(values: IntArray, size: int) -> IntArray:
    """Return 64-bit indices, exactly ``size`` of them."""
    out = np.ascontiguousarray(values, dtype=np.int64)
    if out.shape != (size,):
        raise ValueError(f"expected {size} indices, found shape {out.shape}")
    return out


def small_ints(values: IntArray | SmallIntArray, size: int) -> SmallIntArray:
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


def aligned_zeros(shape: tuple[int, ...]) -> FloatArray:
    """Return zeros that begin where a line of the cache does: 16 doubles then lie in two lines, not in three."""
    size = math.prod(shape)
    room = np.zeros(size + _LINE)
    start = -(room.ctypes.data // room.itemsize) % _LINE
    return room[start : start + size].reshape(shape)


def first_views(held: dict[str, Any]) -> BoolArray:
    """Return (n,) whether no earlier row of the image shows the same point; rows of a point are in order."""
    by_point, image = held["by_point"], held["image_of"]
    again = np.zeros(by_point.size, dtype=bool)
    point = held["point_idx"].take(by_point)
    again[1:] = (point[1:] == point[:-1]) & (image[1:] == image[:-1])
    out = np.ones(by_point.size, dtype=bool)
    out[by_point[again]] = False
    return out


def check_indices(held: dict[str, Any], num_images: int, num_points: int) -> None:
    """Raise ValueError where indices of a joint system lead outside: C follows them without looking."""
    num_rows = len(held["image_idx"])
    for name, limit in (("image_idx", num_images), ("point_idx", num_points), ("by_point", num_rows)):
        values = held[name]
        if values.size and not (values.min() >= 0 and values.max() < limit):
            raise ValueError(f"{name}: expected 0 .. {limit - 1}, found {values.min()} .. {values.max()}")
    for name in ("offsets", "point_offsets"):
        ends = held[name]
        if ends[0] != 0 or ends[-1] != num_rows or (np.diff(ends) < 0).any():
            raise ValueError(f"{name}: expected to rise from 0 to {num_rows}")
