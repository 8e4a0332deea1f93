"""The sums of the joint system, image by image: `joint.c` (what is computed: docs/method.md sections 11 and 11b)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import SmallIntArray, check_indices, doubles, first_views, ints, small_ints
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel, library
from sfm_audit.loaders.arrays import FloatArray, IntArray

SCALAR: Final = 16
"""Scalar functions of a field along one axis: 1, the fourteen monomials, padding."""
DENSE: Final = 12
"""Fields with both components: radial 2, tangential 2, rolling shutter 6, the next radial term, padding."""
FIELDS: Final = 2 * SCALAR + DENSE
DONE: Final = 0
_MOST_VIEWS: Final = 200_000  # of the points of one image; beyond, numpy goes through them in parts


_ARRAYS: Final = (
    *("offsets", "point_offsets", "image_idx", "point_idx", "by_point", "image_of"),
    *("design", "weight", "other_weight", "left", "point_inverse", "other_inverse"),
    *("extra_first", "extra_width", "extra"),
)


class _Model(ctypes.Structure):
    """`joint_model` of joint.c."""

    _fields_ = (
        ("num_images", ctypes.c_int64),
        ("width", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


_ModelPointer: Final = ctypes.POINTER(_Model)


class FirstHalf(NamedTuple):
    """What `JointSums.first` says of an image; F = 44 fields.

    around: (m,) images that see its points, ascending.    right: (rows, F) by image around: columns of the design, then
    its included fields.    gram: (F, F).
    plain: (16, 16) and dense_plain: (12, 12): w E^T E of scalars and of dense fields.
    score: (F,).    track_score: (T, F).    views: what `JointSums.second` needs.
    """

    around: IntArray
    right: FloatArray
    gram: FloatArray
    plain: FloatArray
    dense_plain: FloatArray
    score: FloatArray
    track_score: FloatArray
    views: tuple[SmallIntArray, IntArray, FloatArray]


class _Space(NamedTuple):
    """Arrays that `joint_first` writes to, in its order."""

    view: SmallIntArray
    own: SmallIntArray
    around: IntArray
    start: IntArray
    num: IntArray
    absorbing: FloatArray
    right: FloatArray
    gram: FloatArray
    plain: FloatArray
    dense_plain: FloatArray
    score: FloatArray
    track_score: FloatArray
    scores: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class JointArrays:
    """A joint system as the kernels see it; see `sfm_audit.audit.joint.observations.JointObservations`.

    design: (n, 2, C).    left_px: (n, 2).    weights, inverses: one or two systems, (n,) and (P, 3, 3).
    extra: by image, its included fields (n_i, 2, r).
    """

    offsets: IntArray
    image_idx: IntArray
    point_idx: IntArray
    by_point: IntArray
    point_offsets: IntArray
    design: FloatArray
    left_px: FloatArray
    weights: tuple[FloatArray, ...]
    inverses: tuple[FloatArray, ...]
    extra: dict[int, FloatArray]


class JointSums:
    """Sums over the views of a joint system; several threads may ask at once."""

    def __init__(self, arrays: JointArrays) -> None:
        num_images, num_rows = len(arrays.offsets) - 1, len(arrays.image_idx)
        num_points = len(arrays.point_offsets) - 1
        first = np.full(num_images, -1, dtype=np.int64)
        width = np.zeros(num_images, dtype=np.int64)
        parts: list[FloatArray] = []
        for image, fields in sorted(arrays.extra.items()):
            first[image], width[image] = sum(part.size for part in parts), fields.shape[2]
            parts.append(np.ascontiguousarray(fields))
        extra = np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(1)
        last = len(arrays.weights) - 1
        held: dict[str, Any] = {
            "offsets": ints(arrays.offsets, num_images + 1),
            "image_idx": small_ints(arrays.image_idx, num_rows),
            "point_idx": small_ints(arrays.point_idx, num_rows),
            "by_point": small_ints(arrays.by_point, num_rows),
            "point_offsets": ints(arrays.point_offsets, num_points + 1),
            "design": doubles(arrays.design, (num_rows, 2, arrays.design.shape[2])),
            "weight": doubles(arrays.weights[0], (num_rows,)),
            "other_weight": doubles(arrays.weights[last], (num_rows,)),
            "left": doubles(arrays.left_px, (num_rows, 2)),
            "point_inverse": doubles(arrays.inverses[0], (num_points, 3, 3)),
            "other_inverse": doubles(arrays.inverses[last], (num_points, 3, 3)),
            "extra_first": first,
            "extra_width": width,
            "extra": extra,
        }
        check_indices(held, num_images, num_points)
        held["image_of"] = held["image_idx"].take(held["by_point"])
        self._held = held
        self._widths = arrays.design.shape[2] + width
        self.width = int(arrays.design.shape[2])
        self._model = _Model(num_images, self.width, *(held[name].ctypes.data for name in _ARRAYS))
        self._model.held = held  # whoever keeps the addresses keeps the arrays
        self._num_images = num_images
        views = np.diff(held["point_offsets"])[held["point_idx"]]
        self._is_first = first_views(held)
        self._num_views = np.diff(np.concatenate([[0], np.cumsum(views)])[held["offsets"]])

    @property
    def num_images(self) -> int:
        """Of images."""
        return self._num_images

    @property
    def num_points(self) -> int:
        """Of points."""
        return len(self._held["point_inverse"])

    @property
    def num_rows(self) -> int:
        """Of observations."""
        return len(self._held["weight"])

    @property
    def model(self) -> ctypes.Structure:
        """`joint_model`; it keeps its arrays."""
        return self._model

    @property
    def repeats_follow(self) -> bool:
        """Whether rows of an image that show one point follow each other."""
        point, image = self._held["point_idx"], self._held["image_idx"]
        again = (point[1:] == point[:-1]) & (image[1:] == image[:-1])
        return bool(np.count_nonzero(again) == np.count_nonzero(~self._is_first))

    @property
    def extra_widths(self) -> IntArray:
        """(I,) how many included fields each image has."""
        widths: IntArray = self._held["extra_width"]
        return widths

    def most_of(self, images: IntArray) -> tuple[int, int, int, int]:
        """Return the most rows, views of points and columns around that one of some images has; those of the widest."""
        counts, views = np.diff(self._held["offsets"])[images], int(self._num_views[images].max(initial=0))
        most = min(views, self._num_images)
        columns = most * self.width + int(np.sort(self.extra_widths)[self._num_images - most :].sum())
        return int(counts.max(initial=0)), views, columns, self.width + int(self.extra_widths.max(initial=0))

    def most_around(self, images: IntArray) -> int:
        """Return how many images at most see points that one of some images sees."""
        return int(np.minimum(self._num_views[images], self._num_images).max(initial=0))

    @cached_property
    def track_numbers(self) -> SmallIntArray:
        """(n,) `tracks` of all images."""
        offsets: IntArray = self._held["offsets"]
        if self._is_first.all():
            return (np.arange(offsets[-1]) - np.repeat(offsets[:-1], np.diff(offsets))).astype(np.int32)
        return np.concatenate([self.tracks(image)[0] for image in range(self._num_images)])

    def can(self, image_idx: int) -> bool:
        """Whether the views of an image's points are few enough to be held at once."""
        return bool(self._num_views[image_idx] <= _MOST_VIEWS)

    def tracks(self, image_idx: int) -> tuple[SmallIntArray, int]:
        """Return (n_i,) which distinct point each row shows, -1 - t where an earlier row shows it too; their number."""
        rows = slice(*self._held["offsets"][image_idx : image_idx + 2].tolist())
        is_first = self._is_first[rows]
        if is_first.all():
            return np.arange(is_first.size, dtype=np.int32), is_first.size
        point = self._held["point_idx"][rows]
        number = np.cumsum(is_first) - 1
        firsts = np.flatnonzero(is_first)
        order = firsts[np.argsort(point[firsts], kind="stable")]
        track = number[order[np.searchsorted(point[order], point)]]
        return np.where(is_first, track, -1 - track).astype(np.int32), firsts.size

    def fields(
        self,
        image_idx: int,
        facts: FloatArray,
        xyz_world: FloatArray,
        xy_px: FloatArray,
        *,
        is_fisheye: bool,
        power: int,
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the fields (n_i, 16) and (n_i, 2, 12) of an image; None where one of its points does not project.

        Parameters
        ----------
        facts : (27,) R, t of cam_from_world, fx, fy, half width, half height, half of the larger one, height, R^-1
        xyz_world, xy_px : (n_i, 3) and (n_i, 2) predicted        power : of r^2 in the next radial term, 0 for none
        """
        function = kernel("joint_fields", _ModelPointer, Size, Doubles, Doubles, Doubles, Size, Size, Doubles, Doubles)
        n = self._num_rows(image_idx)
        if function is None or xyz_world.shape != (n, 3) or xy_px.shape != (n, 2) or facts.shape != (27,):
            return None
        scalar, dense = np.empty((n, SCALAR)), np.empty((n, 2, DENSE))
        status = function(
            ctypes.byref(self._model), image_idx, facts, xyz_world, xy_px, int(is_fisheye), power, scalar, dense
        )
        return (scalar, dense) if status == DONE else None

    def first(
        self, image_idx: int, scalar: FloatArray, dense: FloatArray, tracks: tuple[SmallIntArray, int]
    ) -> FirstHalf | None:
        """First half of `candidate_scores`: what an image's fields are to the base, before S^+."""
        function = kernel(
            "joint_first",
            *(
                _ModelPointer,
                Ints,
                Size,
                Doubles,
                Doubles,
                SmallInts,
                Size,
                Size,
                SmallInts,
                SmallInts,
                Ints,
                Ints,
                Ints,
            ),
            *([Doubles] * 8),
            Size,
        )
        n, views = self._num_rows(image_idx), int(self._num_views[image_idx])
        track, num_tracks = tracks
        if function is None or scalar.shape != (n, SCALAR) or dense.shape != (n, 2, DENSE) or track.shape != (n,):
            return None
        space = self._space(views, n, num_tracks)
        status = function(
            ctypes.byref(self._model),
            *(np.zeros(self._num_images, dtype=np.int64), image_idx, scalar, dense, track, num_tracks),
            *(len(space.right), space.view, space.own, space.around, space.start, space.num, space.absorbing),
            *(space.right, space.gram, space.plain, space.dense_plain, space.score, space.track_score),
            *(space.scores, space.scores.size),
        )
        if status != DONE:
            return None
        count, rows = space.num.tolist()
        around, start = space.around[:count], space.start[: count + 1]
        sums = space.gram, space.plain, space.dense_plain, space.score, space.track_score
        return FirstHalf(around, space.right[:rows], *sums, (space.own, start, space.scores))

    def _space(self, num_views: int, num_rows: int, num_tracks: int) -> _Space:
        """Room for what `first` finds of an image."""
        most = min(num_views, self._num_images)
        max_rows, max_scores = most * self.width, num_views * self.width
        if self._held["extra"].size > 1:
            max_rows, max_scores = int(np.sort(self._widths)[-most:].sum()), num_views * int(self._widths.max())
        view, own = np.empty((2, num_views), dtype=np.int32)
        around, start, num = (np.empty(size, dtype=np.int64) for size in (most, most + 1, 2))
        absorbing, right = np.empty((num_rows, 3, 2)), np.empty((max_rows, FIELDS))
        gram, plain, dense_plain = (np.empty((size, size)) for size in (FIELDS, SCALAR, DENSE))
        score, track_score, scores = np.empty(FIELDS), np.empty((num_tracks, FIELDS)), np.empty(max_scores)
        found = gram, plain, dense_plain, score, track_score, scores
        return _Space(view, own, around, start, num, absorbing, right, *found)

    def second(self, first: FirstHalf, tracks: tuple[SmallIntArray, int], moved: FloatArray) -> None:
        """Second half: subtract from ``first.track_score`` what the base does, ``moved`` (rows, F) = T B, in place."""
        function = kernel(
            "joint_second", _ModelPointer, Size, SmallInts, Ints, Ints, SmallInts, Doubles, Doubles, Doubles
        )
        if function is None or moved.shape != first.right.shape:
            raise ValueError("the second half of other kernels or other fields")
        own, start, scores = first.views
        arguments = (own, first.around, start, tracks[0], scores, np.ascontiguousarray(moved), first.track_score)
        function(ctypes.byref(self._model), len(first.around), *arguments)

    def off_points(
        self, values_px: FloatArray, which: int = 0, *, cleaned: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return (P, 3) V^-1 J^T w values, and (n, 2) the values minus what that removes, of one of the systems."""
        function = kernel("joint_off_points", _ModelPointer, Doubles, Doubles, Size, Doubles, Doubles, Doubles, Size)
        if function is None or values_px.shape != self._held["left"].shape:
            raise ValueError("values of other observations, or no kernels")
        weight, inverse = (
            (self._held["other_weight"], self._held["other_inverse"])
            if which
            else (self._held["weight"], self._held["point_inverse"])
        )
        steps, out = np.empty((len(inverse), 3)), np.empty(values_px.shape if cleaned else (0, 2))
        arguments = (weight, inverse, len(inverse), np.ascontiguousarray(values_px), steps, out, int(cleaned))
        function(ctypes.byref(self._model), *arguments)
        return steps, out

    def subtract_step(self, moved: FloatArray, left_px: FloatArray) -> None:
        """Subtract design times ``moved`` (I, C), T step of each image, from ``left_px`` (n, 2), in place."""
        function = kernel("joint_subtract_step", _ModelPointer, Doubles, Doubles)
        if (
            function is None
            or left_px.shape != self._held["left"].shape
            or moved.shape != (self._num_images, self.width)
        ):
            raise ValueError("steps of other images, or no kernels")
        function(ctypes.byref(self._model), moved, left_px)

    def along_design(self, values_px: FloatArray) -> FloatArray:
        """(I, C) w design^T values (n, 2), summed over each image's rows."""
        function = kernel("joint_along_design", _ModelPointer, Doubles, Doubles)
        if function is None or values_px.shape != self._held["left"].shape:
            raise ValueError("values of other observations, or no kernels")
        out = np.empty((self._num_images, self.width))
        function(ctypes.byref(self._model), np.ascontiguousarray(values_px), out)
        return out

    def _num_rows(self, image_idx: int) -> int:
        first, last = self._held["offsets"][image_idx : image_idx + 2].tolist()
        return int(last - first)


def has_joint_kernels() -> bool:
    """Whether the sums come from the compiled library."""
    return library() is not None
