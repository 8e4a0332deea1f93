"""Where the inliers of images lie: hull, occupied cells, median depth: spread.c."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import FloatArray, IndexArray, Int32Array, IntArray


class Inliers(NamedTuple):
    """The inliers of a model, and its poses.

    offsets: (I + 1,) by image; observation_row, point_idx: (n,) rows of xy_px (M, 2) and xyz_world (P, 3).
    quaternions, translations: (I, 4), (I, 3) cam_from_world.
    """

    offsets: IntArray
    observation_row: Int32Array
    point_idx: IndexArray
    xy_px: FloatArray
    xyz_world: FloatArray
    quaternions: FloatArray
    translations: FloatArray


class Lie(NamedTuple):
    """Where the inliers of B images lie, (B,) each: area of their hull, occupied cells, median Zc (NaN without any)."""

    hull_px2: FloatArray
    occupied_cells: IntArray
    median_depth: FloatArray


def image_spread(inliers: Inliers, image_idxs: IntArray, size_px: FloatArray, grid: int) -> Lie | None:
    """Return where the inliers of some images lie; None for the numpy path.

    Parameters
    ----------
    image_idxs : (B,)        size_px : (B, 2) width and height        grid : cells per side

    Raises
    ------
    IndexError
        where an index or an offset does not fit its table.
    """
    types = (
        Size,
        Ints,
        Ints,
        SmallInts,
        SmallInts,
        Doubles,
        Doubles,
        Doubles,
        Doubles,
        Doubles,
        Size,
        Doubles,
        Ints,
        Doubles,
    )
    run = kernel("image_spread", *types)
    if run is None:
        return None
    _check(inliers, image_idxs)
    num = len(image_idxs)
    out = Lie(np.empty(num), np.empty(num, dtype=np.int64), np.empty(num))
    offsets = np.ascontiguousarray(inliers.offsets, dtype=np.int64)
    rows = (offsets, *(small_ints(each, len(each)) for each in (inliers.observation_row, inliers.point_idx)))
    values = (np.ascontiguousarray(each, dtype=np.float64) for each in inliers[3:])
    sizes = np.ascontiguousarray(size_px, dtype=np.float64)
    status = run(num, np.ascontiguousarray(image_idxs, dtype=np.int64), *rows, *values, sizes, grid, *out)
    return None if status else out


def _check(inliers: Inliers, image_idxs: IntArray) -> None:
    """See that no row is beyond its table; of the images asked alone."""
    num_images = min(len(inliers.offsets) - 1, len(inliers.quaternions), len(inliers.translations))
    if len(image_idxs) and not 0 <= image_idxs.min() <= image_idxs.max() < num_images:
        raise IndexError(f"images {image_idxs.min()} .. {image_idxs.max()} of {num_images}")
    first, last = inliers.offsets[image_idxs], inliers.offsets[image_idxs + 1]
    size = min(len(inliers.observation_row), len(inliers.point_idx))
    if len(first) and not (first.min() >= 0 and (first <= last).all() and last.max() <= size):
        raise IndexError("offsets of inliers do not fit their table")
    own = slice(first.min(), last.max()) if len(first) else slice(0, 0)
    for name, rows, table in (
        ("observation", inliers.observation_row[own], inliers.xy_px),
        ("point", inliers.point_idx[own], inliers.xyz_world),
    ):
        if rows.size and not 0 <= rows.min() <= rows.max() < len(table):
            raise IndexError(f"{name} {rows.min()} or {rows.max()} of {len(table)}")
