"""What the joint system is made of: derivatives, the information on points, entries of an inverse (`joint_parts.c`)."""

from __future__ import annotations

import ctypes
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import SmallIntArray, small_ints
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import FloatArray, IntArray

_DONE: Final = 0


class DesignInputs(NamedTuple):
    """What the design of an image is made of.

    facts: (25,) R, its inverse, t, fx, fy, cx, cy.
    own: (k,) of each own parameter: 0 focal length of both axes, 1 of x, 2 of y, 3 + e distortion parameter e.
    jacobian: (2, 3, N) in the points of all inliers of the model.
    source: (n,) columns of it.    first: column of the image's first inlier.
    xyz_world: (n, 3).    xy_px: (n, 2) predicted.    d_extra: (e, 2, m) of the image's m inliers.
    """

    facts: FloatArray
    own: IntArray
    jacobian: FloatArray
    source: IntArray
    first: int
    xyz_world: FloatArray
    xy_px: FloatArray
    d_extra: FloatArray


def fill_design(out: FloatArray, given: DesignInputs) -> bool:
    """Write the design (n, 2, C) of an image; False for the numpy path."""
    function = kernel(
        "joint_design",
        *([Size] * 5),
        *(Doubles, Ints, Doubles, Ints, Size, Doubles, Doubles, Doubles, Doubles),
    )
    n, width, num_all = len(out), out.shape[2], given.d_extra.shape[2]
    local = given.source - given.first
    is_sound = (
        given.jacobian.flags.c_contiguous
        and given.xyz_world.shape == (n, 3)
        and given.xy_px.shape == (n, 2)
        and given.source.shape == (n,)
        and given.facts.shape == (25,)
        and 6 + given.own.size <= width
        and (not n or (local.min() >= 0 and given.source.max() < given.jacobian.shape[2]))
        and (not given.own.size or (given.own.min() >= 0 and given.own.max() < 3 + len(given.d_extra)))
        and (not (given.own >= 3).any() or not n or local.max() < num_all)
    )
    if function is None or not is_sound:
        return False
    function(
        *(n, width, given.jacobian.shape[2], num_all, given.own.size, given.facts, given.own, given.jacobian),
        *(given.source, given.first, given.xyz_world, np.ascontiguousarray(given.xy_px)),
        *(np.ascontiguousarray(given.d_extra), out),
    )
    return True


def point_information(
    jacobian: FloatArray, weight: FloatArray, point_idx: IntArray, num_points: int
) -> FloatArray | None:
    """V (P, 3, 3): sum of w J^T J over a point's views, of J (2, 3, n); None for the numpy path."""
    function = kernel("joint_information", Size, Size, Doubles, Doubles, SmallInts, Doubles)
    n = weight.size
    if function is None or jacobian.shape != (2, 3, n) or not jacobian.flags.c_contiguous:
        return None
    index = small_ints(point_idx, n)
    if n and not (int(index.min()) >= 0 and int(index.max()) < num_points):
        return None
    out = np.empty((num_points, 3, 3))
    function(n, num_points, jacobian, np.ascontiguousarray(weight), index, out)
    return out


def unit_determinants(matrices: FloatArray, *, smallest: float, invert: bool) -> FloatArray | None:
    """(P,) determinants of (P, 3, 3) scaled to unit diagonal; inverts them in place where asked to. None: numpy path.

    Parameters
    ----------
    smallest : squares of the scale below it count as it
    """
    function = kernel("joint_invert", Size, Doubles, Doubles, ctypes.c_double, Size)
    if function is None:
        return None
    out = np.empty(len(matrices))
    function(len(matrices), matrices, out, smallest, int(invert))
    return out


class Sight(NamedTuple):
    """Points in the order in which images first see them, and each image's rows in that order.

    points: (Q,) those that are seen.    order: (n,) former row of each row.    point_idx: (n,) places in ``points``.
    by_point: (n,) rows by point, then in order; point_offsets: (Q + 1,) where each point's begin.
    """

    points: IntArray
    order: IntArray
    point_idx: IntArray
    by_point: IntArray
    point_offsets: IntArray


def in_order_of_sight(image_idx: IntArray, point_idx: IntArray, offsets: IntArray, num_points: int) -> Sight | None:
    """Return the order of rows (n,) by image, ``offsets`` (I + 1,); None for the numpy path."""
    function = kernel("joint_by_sight", Size, Size, Size, *([Ints] * 9))
    n, num_images = point_idx.size, len(offsets) - 1
    if function is None or image_idx.shape != (n,) or offsets[-1] != n:
        return None
    given = (np.ascontiguousarray(values, dtype=np.int64) for values in (image_idx, point_idx))
    ends, number, points = offsets[:-1].astype(np.int64), *np.empty((2, num_points), dtype=np.int64)
    order, new_idx, by_point = np.empty((3, n), dtype=np.int64)
    starts = np.empty(num_points + 1, dtype=np.int64)
    count = function(n, num_images, num_points, *given, ends, number, points, order, new_idx, by_point, starts)
    if count < 0 or not np.array_equal(ends, offsets[1:]):
        return None
    return Sight(points[:count].copy(), order, new_idx, by_point, starts[: count + 1].copy())


def two_informations(
    design: FloatArray, weights: tuple[FloatArray, FloatArray], point_idx: IntArray, num_points: int
) -> tuple[FloatArray, FloatArray] | None:
    """V (P, 3, 3) with either weight (n,), of the design (n, 2, C); None for the numpy path."""
    function = kernel("joint_two_informations", Size, Size, Size, Doubles, Doubles, Doubles, Ints, Doubles, Doubles)
    n = point_idx.size
    if function is None or design.shape[:2] != (n, 2) or any(weight.shape != (n,) for weight in weights):
        return None
    out = np.empty((num_points, 3, 3)), np.empty((num_points, 3, 3))
    given = (np.ascontiguousarray(values) for values in (design, *weights))
    index = np.ascontiguousarray(point_idx, dtype=np.int64)
    return out if function(n, design.shape[2], num_points, *given, index, *out) == _DONE else None


def near_entries(
    place: IntArray, first: IntArray, near: FloatArray, starts: IntArray, columns: IntArray
) -> FloatArray | None:
    """(s, s) entries at sorted places of a banded symmetric matrix; None where not all are at hand, or without kernels.

    Parameters
    ----------
    first : (b + 1,) place where each block begins and the last one ends
    near : (m,) of each block its rows' entries at the columns of the block and of those behind it
    starts, columns : (b + 1,) where each block begins in it, and (b,) how many columns it has
    """
    function = kernel("joint_near_entries", Size, Ints, Ints, Doubles, Ints, Ints, Size, Doubles)
    if function is None:
        return None
    if not len(starts) == len(first) == len(columns) + 1 or starts[-1] != near.size:
        raise ValueError("blocks of another band")
    out = np.empty((place.size, place.size))
    found = function(place.size, place, first, near, starts, columns, len(columns), out)
    return out if found == _DONE else None


def dense_entries(matrix: FloatArray, columns: IntArray) -> FloatArray | None:
    """(s, s) entries of a symmetric matrix (D, D), in C or Fortran order, at some columns; None for the numpy path."""
    function = kernel("joint_dense_entries", Size, Ints, Size, Doubles, Doubles)
    in_order = matrix if matrix.flags.c_contiguous else matrix.T
    if function is None or not in_order.flags.c_contiguous:
        return None
    out = np.empty((columns.size, columns.size))
    status = function(columns.size, np.ascontiguousarray(columns, dtype=np.int64), len(matrix), in_order, out)
    return out if status == _DONE else None


def symmetric_of_blocks(
    size: int, rows: IntArray, columns: IntArray, blocks: FloatArray
) -> tuple[FloatArray, SmallIntArray, IntArray] | None:
    """Data, columns and starts of rows of the sparse A + A^T (D, D); None for the numpy path.

    Parameters
    ----------
    rows, columns, blocks : (m, r), (m, c) and (m, r, c) of A; D is padding
    """
    function = kernel("joint_symmetric", *([Size] * 4), Ints, Ints, Doubles, Size, Ints, SmallInts, Doubles)
    num, height, width = blocks.shape
    if function is None or not blocks.size or max(size, num) >= np.iinfo(np.int32).max:
        return None
    if rows.shape != (num, height) or columns.shape != (num, width) or min(rows.min(), columns.min()) < 0:
        raise ValueError("blocks of another matrix")
    room = 2 * blocks.size
    starts, indices, data = np.empty(size + 1, dtype=np.int64), np.empty(room, dtype=np.int32), np.empty(room)
    given = np.ascontiguousarray(rows), np.ascontiguousarray(columns), np.ascontiguousarray(blocks)
    count = function(size, num, height, width, *given, room, starts, indices, data)
    return (data[:count], indices[:count], starts) if count >= 0 else None
