"""Blocks of the normal equations and of the sandwich, of ranges of images (`joint_normal.c`)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints
from sfm_audit.audit.kernels.joint import JointSums
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import FloatArray, IntArray

_PAIRS_AT_ONCE: Final = 4096
_MODEL: Final = ctypes.c_void_p


class PairBlocks(NamedTuple):
    """Blocks between images that see points together.

    counts: (k,) images of each of k images: itself and those behind it that see its points.    around: (m,) these.
    slabs: (s, m, C, C) between each of them (rows) and the image (columns), its own one halved, of s systems.
    """

    counts: IntArray
    around: IntArray
    slabs: FloatArray


class NormalBlocks(NamedTuple):
    """What k images add to the normal equations of two systems: grams (k, 2, C, C) of own rows, rights (k, 2, C)."""

    pairs: PairBlocks
    grams: FloatArray
    rights: FloatArray


class _Room(NamedTuple):
    """What a kernel writes to: counts of all images, around (room,), slabs (s, room, C, C)."""

    counts: IntArray
    around: IntArray
    slabs: FloatArray


class OtherSystem(NamedTuple):
    """A second system beside that of the sums, and what pulls the points in both.

    plain: (I,) its weight of all rows of an image.    inverse: (P, 3, 3) V^-1.    pulls: (P, 3) J^T w y of both.
    """

    plain: FloatArray
    inverse: FloatArray
    pulls: tuple[FloatArray, FloatArray]


def normals(sums: JointSums, images: IntArray, transform: FloatArray, other: OtherSystem) -> NormalBlocks | None:
    """Return what some images add to the normal equations of two systems; None for the numpy path.

    Parameters
    ----------
    sums : with the residuals y in the place of y~        transform : (I, C, C) T
    """
    pointers = *([Doubles] * 5), Size, Ints, Ints, *([Doubles] * 4)
    function, width, num_points = kernel("joint_normals", _MODEL, Size, Ints, *pointers), sums.width, sums.num_points
    if function is None:
        return None
    grams, rights = np.empty((len(images), 2, width, width)), np.empty((len(images), 2, width))
    given = (
        doubles(other.plain, (sums.num_images,)),
        doubles(other.inverse, (num_points, 3, 3)),
        *(doubles(pull, (num_points, 3)) for pull in other.pulls),
    )

    def some(first: int, room: _Room) -> int:
        found = room.counts[first:], room.around, *room.slabs, grams[first:], rights[first:]
        asked = len(images) - first, images[first:], transform, *given, len(room.around)
        return int(function(ctypes.byref(sums.model), *asked, *found))

    pairs = _in_turn(sums, images, transform, 2, some)
    return None if pairs is None else NormalBlocks(pairs, grams, rights)


def meats(sums: JointSums, images: IntArray, transform: FloatArray) -> PairBlocks | None:
    """Return scores times scores of some images, by track; None for the numpy path. transform: (I, C, C) T."""
    pointers = Doubles, Size, Ints, Ints, Doubles
    function = kernel("joint_meats", _MODEL, Size, Ints, *pointers)
    if function is None:
        return None

    def some(first: int, room: _Room) -> int:
        asked = len(images) - first, images[first:], transform, len(room.around)
        return int(function(ctypes.byref(sums.model), *asked, room.counts[first:], room.around, room.slabs[0]))

    return _in_turn(sums, images, transform, 1, some)


def _in_turn(
    sums: JointSums, images: IntArray, transform: FloatArray, num_systems: int, some: Callable[[int, _Room], int]
) -> PairBlocks | None:
    """Ask until all images are done; each time as many as find room."""
    width, num = sums.width, len(images)
    doubles(transform, (sums.num_images, width, width))
    if num and not (ints(images, num).min() >= 0 and images.max() < sums.num_images):
        raise ValueError(f"images: expected 0 .. {sums.num_images - 1}")
    most = max(_PAIRS_AT_ONCE, sums.most_around(images))
    counts = np.empty(num, dtype=np.int64)
    parts = [(np.empty(0, dtype=np.int64), np.empty((num_systems, 0, width, width)))]
    first = 0
    while first < num:
        room = _Room(counts, np.empty(most, dtype=np.int64), np.empty((num_systems, most, width, width)))
        done = some(first, room)
        if done <= 0:
            return None
        used = int(counts[first : first + done].sum())
        parts.append((room.around[:used], room.slabs[:, :used]))
        first += done
    around, slabs = zip(*parts, strict=True)
    return PairBlocks(counts, np.concatenate(around), np.concatenate(slabs, axis=1))
