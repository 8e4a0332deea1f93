"""What the joint system is made of: derivatives, the information on points, entries of an inverse (`joint_parts.c`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints, small_ints
from sfm_audit.audit.kernels.joint import DONE, JointIndex
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray

_DONE: Final = 0


class DesignInputs(NamedTuple):
    """What the design of the chosen rows (n,) of k images is made of, one image after the other.

    offsets: (k + 1,) image i has the rows offsets[i]:offsets[i + 1].
    facts: (k, 25) of each R, its inverse, t, fx, fy, cx, cy.
    own: (k, Q) of each own parameter: 0 focal length of both axes, 1 of x, 2 of y, 3 + e distortion
    parameter e; -1 none.
    jacobian: (2, 3, N) in the points, residuals_px: (2, N), of all inliers of the model.
    source: (n,) columns of both.    first: (k,) columns of the images' first inliers.
    point_idx, observation_row: (N,) rows of xyz_world (P, 3) and of observed_px (M, 2).
    d_extra: of each image (e, 2, m), of its m inliers.
    """

    offsets: IntArray
    facts: FloatArray
    own: IntArray
    jacobian: FloatArray
    residuals_px: FloatArray
    source: IntArray
    first: IntArray
    point_idx: Int32Array
    observation_row: Int32Array
    xyz_world: FloatArray
    observed_px: FloatArray
    d_extra: Sequence[FloatArray]


def fill_design(out: FloatArray, given: DesignInputs) -> bool:
    """Write the design (n, 2, C) of some images; False for the numpy path."""
    of_images, of_rows = (Ints, Doubles, Ints), (Doubles, Doubles, *([Ints] * 4))
    function = kernel(
        "joint_designs", *([Size] * 3), *of_images, *of_rows, Size, Size, SmallInts, SmallInts, *([Doubles] * 4)
    )
    (n, _, width), (k, num_own), num_all = out.shape, given.own.shape, given.jacobian.shape[2]
    counts = np.array([each.shape[2] for each in given.d_extra], dtype=np.int64)
    is_sound = (
        given.jacobian.flags.c_contiguous
        and given.residuals_px.flags.c_contiguous
        and given.residuals_px.shape == (2, num_all)
        and given.source.shape == (n,)
        and given.facts.shape == (k, 25)
        and 6 + num_own == width
        and len(given.d_extra) == k
        and _lie_inside(given, counts)
    )
    if function is None or not is_sound:
        return False
    sizes = [each.size for each in given.d_extra]
    starts = np.cumsum([0, *sizes])[:-1].astype(np.int64)
    extra = np.concatenate([each.ravel() for each in given.d_extra]) if sum(sizes) else np.zeros(1)
    images = ints(given.offsets, k + 1), given.facts, np.ascontiguousarray(given.own)
    columns = given.jacobian, given.residuals_px, given.source, given.first, counts, starts
    xyz, observed = (np.ascontiguousarray(each) for each in (given.xyz_world, given.observed_px))
    looked_up = small_ints(given.point_idx, num_all), small_ints(given.observation_row, num_all), xyz, observed
    return int(function(k, width, num_all, *images, *columns, len(xyz), len(observed), *looked_up, extra, out)) == DONE


def _lie_inside(given: DesignInputs, counts: IntArray) -> bool:
    """Whether all that the kernel looks up is there."""
    n, num_all = given.source.size, given.jacobian.shape[2]
    ends, most = given.offsets, np.array([len(each) for each in given.d_extra], dtype=np.int64) + 3
    if ends[0] != 0 or ends[-1] != n or (np.diff(ends) < 0).any() or (given.own >= most[:, None]).any():
        return False
    if not n:
        return True
    local = given.source - np.repeat(given.first, np.diff(ends))
    asks = np.repeat((given.own >= 3).any(axis=1), np.diff(ends))
    is_there = local < np.repeat(counts, np.diff(ends))
    return bool(given.source.min() >= 0 and given.source.max() < num_all and local.min() >= 0 and is_there[asks].all())


def point_information(
    jacobian: FloatArray, weight: FloatArray, point_idx: Int32Array | IntArray, num_points: int
) -> tuple[FloatArray, IntArray] | None:
    """V (P, 3, 3): sum of w J^T J over a point's views, of J (2, 3, n); (P,) its views with w > 0. None: numpy path."""
    function = kernel("joint_information", Size, Size, Doubles, Doubles, SmallInts, Doubles, Ints)
    n = weight.size
    if function is None or jacobian.shape != (2, 3, n) or not jacobian.flags.c_contiguous:
        return None
    index = small_ints(point_idx, n)
    if n and not (int(index.min()) >= 0 and int(index.max()) < num_points):
        return None
    out, views = np.empty((num_points, 3, 3)), np.empty(num_points, dtype=np.int64)
    function(n, num_points, jacobian, np.ascontiguousarray(weight), index, out, views)
    return out, views


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
    point_idx: Int32Array
    by_point: Int32Array
    point_offsets: IntArray


def in_order_of_sight(image_idx: Int32Array, point_idx: Int32Array, offsets: IntArray, num_points: int) -> Sight | None:
    """Return the order of rows (n,) by image, ``offsets`` (I + 1,); None for the numpy path."""
    pointers = *([SmallInts] * 2), Ints, SmallInts, Ints, Ints, *([SmallInts] * 2), Ints
    function = kernel("joint_by_sight", Size, Size, Size, *pointers)
    n, num_images = point_idx.size, len(offsets) - 1
    if function is None or image_idx.shape != (n,) or offsets[-1] != n or max(n, num_points) >= np.iinfo(np.int32).max:
        return None
    given = small_ints(image_idx, n), small_ints(point_idx, n)
    ends, number, points = offsets[:-1].astype(np.int64), np.empty(num_points, np.int32), np.empty(num_points, np.int64)
    order, new_idx, by_point = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    starts = np.empty(num_points + 1, dtype=np.int64)
    count = function(n, num_images, num_points, *given, ends, number, points, order, new_idx, by_point, starts)
    if count < 0 or not np.array_equal(ends, offsets[1:]):
        return None
    return Sight(points[:count].copy(), order, new_idx, by_point, starts[: count + 1].copy())


def components(index: JointIndex, together: IntArray) -> IntArray | None:
    """(I,) the first image that each image hangs together with by points; None for the numpy path.

    Parameters
    ----------
    together : (I,) an image that each hangs together with anyway, itself or one before it
    """
    function = kernel("joint_components", Size, Size, Ints, SmallInts, Ints)
    label, arrays = ints(together, index.num_images).copy(), index.arrays
    if not ((label >= 0) & (label <= np.arange(label.size))).all():
        raise ValueError("together: expected images that are not behind")
    if function is None:
        return None
    function(index.num_images, index.num_points, arrays["point_offsets"], arrays["image_of"], label)
    return label


class TwoInformations(NamedTuple):
    """V (P, 3, 3) and the pull J^T w y (P, 3) of two systems."""

    informations: tuple[FloatArray, FloatArray]
    pulls: tuple[FloatArray, FloatArray]


def two_informations(
    index: JointIndex, design: FloatArray, weight: FloatArray, plain: FloatArray, values_px: FloatArray
) -> TwoInformations | None:
    """What is summed up by point with either weight; None for the numpy path.

    Parameters
    ----------
    design : (n, 2, C)        weight : (n,)        plain : (I,) the other weight, of all rows of an image
    values_px : (n, 2) y
    """
    sizes, pointers = [Size] * 3, [Doubles] * 4
    function = kernel("joint_two_informations", *sizes, Ints, *pointers, SmallInts, *pointers)
    n, width, num_points = index.num_rows, design.shape[2], index.num_points
    if function is None:
        return None
    given = doubles(design, (n, 2, width)), doubles(weight, (n,)), doubles(plain, (index.num_images,))
    out = np.empty((num_points, 3, 3)), np.empty((num_points, 3, 3))
    pulls = np.empty((num_points, 3)), np.empty((num_points, 3))
    values = doubles(values_px, (n, 2)), index.arrays["point_idx"]
    status = function(index.num_images, width, num_points, index.offsets, *given, *values, *out, *pulls)
    return TwoInformations(out, pulls) if status == _DONE else None


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
