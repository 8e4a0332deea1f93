"""The sums of the joint system, image by image: `joint.c` (what is computed: docs/method.md sections 11 and 11b)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from sfm_audit.audit.kernels.checked import SmallIntArray, check_indices, doubles, first_views, ints, small_ints
from sfm_audit.audit.kernels.library import Doubles, Size, kernel, library
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

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

    @cached_property
    def _is_first(self) -> BoolArray:
        """(n,) whether no earlier row of the image shows the same point."""
        return first_views(self._held)

    @cached_property
    def _num_views(self) -> IntArray:
        """(I,) views of the points of each image."""
        views = np.diff(self._held["point_offsets"])[self._held["point_idx"]]
        return np.asarray(np.diff(np.concatenate([[0], np.cumsum(views)])[self._held["offsets"]]))

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


def has_joint_kernels() -> bool:
    """Whether the sums come from the compiled library."""
    return library() is not None
