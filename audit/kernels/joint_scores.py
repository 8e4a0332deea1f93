"""The scores of the candidate fields of many images in one call (`joint_scores.c`)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_audit.audit.kernels.checked import doubles, ints, small_ints
from sfm_audit.audit.kernels.joint import DENSE, DONE, FIELDS, SCALAR, JointSums
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray

_FACTS: Final = 27


@dataclass(frozen=True, slots=True, eq=False)
class BandArrays:
    """A banded S^+ by places; see `sfm_audit.audit.joint.banded.BandedInverse`.

    place: (D,) of each column, those of the border behind the last block.    first: (b + 1,) where each block begins,
    the end.    near: (m,), one block behind the other; starts: (b + 1,); columns: (b,) of each block.
    aside, pull: (D, g) A and B, by place.    scale: (D,) 1 / D, by column.
    """

    place: IntArray
    first: IntArray
    near: FloatArray
    starts: IntArray
    columns: IntArray
    aside: FloatArray
    pull: FloatArray
    scale: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class IncludedArrays:
    """What was included since; see `sfm_audit.audit.joint.inverse.JointInverse`.

    update: (D, k).    border: (D, m).    corner: (m, m).    first: (I,) an image's first column of the border, or -1.
    """

    update: FloatArray
    border: FloatArray
    corner: FloatArray
    first: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class SeenArrays:
    """Where points and observations of a model are found.

    xyz_world: (R, 3).    xy_px: (M, 2) observed.    residuals_px: (2, N).    observation_row: (N,) rows of ``xy_px``.
    points: (P,) rows of ``xyz_world``.    source: (n,) columns of ``residuals_px``.
    """

    xyz_world: FloatArray
    xy_px: FloatArray
    residuals_px: FloatArray
    observation_row: Int32Array
    points: IntArray
    source: IntArray


class Asked(NamedTuple):
    """Of which images: images (k,), facts (k, 27) of `JointSums.fields`, is_fisheye (k,), power (k,)."""

    images: IntArray
    facts: FloatArray
    is_fisheye: IntArray
    power: IntArray


class Scores(NamedTuple):
    """What `JointScores.of` says of k images; F = 44 functions, C columns of an image.

    done: (k,) whether the rest holds.    num_tracks: (k,).    gram, meat: (k, F, F).
    plain: (k, 16, 16) w E^T E of scalars.    dense_plain: (k, 12) its diagonal for dense fields.    score: (k, F).
    right, solution: (k, C, F) R and B = S^+ R at the image's own columns, zero where it has none.
    """

    done: IntArray
    num_tracks: IntArray
    gram: FloatArray
    meat: FloatArray
    plain: FloatArray
    dense_plain: FloatArray
    score: FloatArray
    right: FloatArray
    solution: FloatArray

    def only(self, chosen: IntArray) -> Scores:
        """Those of some of the images."""
        return Scores(*(each[chosen] for each in self))  # type: ignore[arg-type]


class _Inverse(ctypes.Structure):
    """`base_inverse` of joint_scores.c."""

    _fields_ = (
        *(("size", ctypes.c_int64), ("width", ctypes.c_int64)),
        *((name, ctypes.c_void_p) for name in ("columns", "transform", "dense")),
        *((name, ctypes.c_int64) for name in ("num_banded", "num_blocks", "num_outer")),
        *(
            (name, ctypes.c_void_p)
            for name in ("place", "block", "first", "starts", "block_columns", "near", "aside", "pull", "scale")
        ),
        *((name, ctypes.c_int64) for name in ("num_update", "num_extra")),
        *((name, ctypes.c_void_p) for name in ("update", "border", "corner", "extra_column")),
    )


class _Seen(ctypes.Structure):
    """`seen_points` of joint.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("xyz", "observed", "residuals", "points", "source", "observation_row")),
        ("num_residuals", ctypes.c_int64),
    )


class JointScores:
    """Asks the kernel about images of one base; several threads may ask at once."""

    def __init__(
        self,
        sums: JointSums,
        columns: IntArray,
        transform: FloatArray,
        inverse: FloatArray | BandArrays,
        *,
        included: IncludedArrays,
        seen: SeenArrays,
    ) -> None:
        self._sums, width = sums, sums.width
        size = len(inverse.place) if isinstance(inverse, BandArrays) else len(inverse)
        num_images = sums.num_images
        if not (columns.size == 0 or (columns.min() >= 0 and columns.max() <= size)):
            raise ValueError(f"columns: expected 0 .. {size}")
        self._held: list[object] = [
            np.ascontiguousarray(columns, dtype=np.int64).reshape(num_images, width),
            doubles(transform, (num_images, width, width)),
        ]
        self._inverse = _Inverse(size, width, *(self._held[k].ctypes.data for k in range(2)))  # type: ignore[attr-defined]
        if isinstance(inverse, BandArrays):
            self._take_band(inverse, size)
        else:
            self._inverse.dense = self._kept(doubles(inverse, (size, size)))
        self._take_included(included, size)
        self._seen = seen_points(seen, sums, self._held)
        self._inverse.held = self._seen.held = self._held  # whoever keeps the addresses keeps the arrays

    def _kept(self, array: npt.NDArray[Any]) -> int:
        """Address of an array that lives as long as the structures do."""
        self._held.append(array)
        return array.ctypes.data

    def _take_band(self, band: BandArrays, size: int) -> None:
        num_blocks = len(band.columns)
        place, starts, columns = (
            ints(band.place, size),
            ints(band.starts, num_blocks + 1),
            ints(band.columns, num_blocks),
        )
        first = ints(band.first, num_blocks + 1)
        rows, num_banded = np.diff(first), int(first[-1])
        is_sound = (
            first[0] == 0
            and num_banded <= size
            and (rows >= 0).all()
            and (not size or (place.min() >= 0 and place.max() < size))
            and starts[0] == 0
            and starts[-1] == band.near.size
            and np.array_equal(np.diff(starts), rows * columns)
        )
        if not is_sound:
            raise ValueError("blocks of another band")
        num_outer = band.aside.shape[1]
        self._inverse.num_banded, self._inverse.num_blocks, self._inverse.num_outer = num_banded, num_blocks, num_outer
        given = {
            "place": place,
            "block": np.repeat(np.arange(num_blocks), rows),
            "first": first,
            "starts": starts,
            "block_columns": columns,
            "near": doubles(band.near, band.near.shape),
        }
        given |= {name: doubles(getattr(band, name), (size, num_outer)) for name in ("aside", "pull")}
        for name, array in {**given, "scale": doubles(band.scale, (size,))}.items():
            setattr(self._inverse, name, self._kept(array))

    def _take_included(self, included: IncludedArrays, size: int) -> None:
        num_update, num_extra = included.update.shape[1], included.border.shape[1]
        first = ints(included.first, self._sums.num_images)
        width = self._sums.extra_widths
        if not ((width == 0) | ((first >= 0) & (first + width <= num_extra))).all():
            raise ValueError(f"first: included fields lie outside of {num_extra} columns")
        self._inverse.num_update, self._inverse.num_extra = num_update, num_extra
        self._inverse.update = self._kept(doubles(included.update, (size, num_update)))
        self._inverse.border = self._kept(doubles(included.border, (size, num_extra)))
        self._inverse.corner = self._kept(doubles(included.corner, (num_extra, num_extra)))
        self._inverse.extra_column = self._kept(first)

    def of(self, asked: Asked) -> Scores | None:
        """Return what the tests of some images need; None without kernels."""
        function = kernel(
            "joint_scores", *([ctypes.c_void_p] * 3), Size, Ints, Doubles, Ints, Ints, *([Size] * 4), *_OUT
        )
        k, width = len(asked.images), self._sums.width
        images = ints(asked.images, k)
        if function is None or (k and not (images.min() >= 0 and images.max() < self._sums.num_images)):
            return None
        status, num_tracks = np.ones(k, dtype=np.int64), np.zeros(k, dtype=np.int64)
        gram, meat = np.empty((2, k, FIELDS, FIELDS))
        plain, dense_plain = np.empty((k, SCALAR, SCALAR)), np.empty((k, DENSE))
        score, right, solution = np.empty((k, FIELDS)), np.empty((k, width, FIELDS)), np.empty((k, width, FIELDS))
        given = images, doubles(asked.facts, (k, _FACTS)), ints(asked.is_fisheye, k), ints(asked.power, k)
        found = num_tracks, gram, meat, plain, dense_plain, score, right, solution
        model = (ctypes.byref(each) for each in (self._sums.model, self._inverse, self._seen))
        done = function(*model, k, *given, *self._sums.most_of(images), status, *found)
        return Scores(status == DONE, *found) if done == DONE else None


def seen_points(seen: SeenArrays, sums: JointSums, held: list[object]) -> ctypes.Structure:
    """Return `seen_points` of joint.h for a model; ``held`` gets the arrays that it points to."""
    num = seen.observation_row.size
    row = small_ints(seen.observation_row, num)
    points, source = ints(seen.points, sums.num_points), ints(seen.source, sums.num_rows)
    for name, index, limit in (
        ("observation_row", row, len(seen.xy_px)),
        ("points", points, len(seen.xyz_world)),
        ("source", source, num),
    ):
        if index.size and not (index.min() >= 0 and index.max() < limit):
            raise ValueError(f"{name}: expected 0 .. {limit - 1}, found {index.min()} .. {index.max()}")
    given = (
        doubles(seen.xyz_world, (len(seen.xyz_world), 3)),
        doubles(seen.xy_px, (len(seen.xy_px), 2)),
        doubles(seen.residuals_px, (2, num)),
    )
    arrays = *given, points, source, row
    held += arrays
    return _Seen(*(array.ctypes.data for array in arrays), num)


_OUT: Final = (Ints, Ints, *([Doubles] * 7))
