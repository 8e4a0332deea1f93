"""The sums of the joint system, image by image: `joint.c` (what is computed: docs/method.md sections 11 and 11b)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from sfm_audit.audit.kernels.checked import check_indices, doubles, first_views, ints, small_ints
from sfm_audit.audit.kernels.library import Doubles, Size, kernel, library
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

SCALAR: Final = 16
"""Scalar functions of a field along one axis: 1, the fourteen monomials, padding."""
DENSE: Final = 12
"""Fields with both components: radial 2, tangential 2, rolling shutter 6, the next radial term, padding."""
FIELDS: Final = 2 * SCALAR + DENSE
DONE: Final = 0
_MOST_VIEWS: Final = 200_000  # of the points of one image; beyond, numpy goes through them in parts


_INDICES: Final = ("offsets", "point_offsets", "image_idx", "point_idx", "by_point", "image_of")
_ARRAYS: Final = (
    *_INDICES,
    *("design", "weight", "left", "point_inverse"),
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


class JointIndex:
    """Who sees what in a joint system: checked once, for all sums over it.

    Parameters
    ----------
    offsets, image_idx, point_idx, by_point, point_offsets : see `sfm_audit.audit.joint.observations.JointObservations`
    """

    def __init__(
        self,
        offsets: IntArray,
        image_idx: Int32Array,
        point_idx: Int32Array,
        by_point: Int32Array,
        point_offsets: IntArray,
    ) -> None:
        self.num_images, self.num_points, self.num_rows = len(offsets) - 1, len(point_offsets) - 1, len(image_idx)
        self.arrays: dict[str, Any] = {
            "offsets": ints(offsets, self.num_images + 1),
            "image_idx": small_ints(image_idx, self.num_rows),
            "point_idx": small_ints(point_idx, self.num_rows),
            "by_point": small_ints(by_point, self.num_rows),
            "point_offsets": ints(point_offsets, self.num_points + 1),
        }
        check_indices(self.arrays, self.num_images, self.num_points)
        self.arrays["image_of"] = self.arrays["image_idx"].take(self.arrays["by_point"])

    @property
    def offsets(self) -> IntArray:
        """(I + 1,) image i owns rows offsets[i]:offsets[i + 1]."""
        offsets: IntArray = self.arrays["offsets"]
        return offsets

    @cached_property
    def is_first(self) -> BoolArray:
        """(n,) whether no earlier row of the image shows the same point."""
        return first_views(self.arrays)

    @cached_property
    def num_views(self) -> IntArray:
        """(I,) views of the points of each image."""
        per_point = np.diff(self.arrays["point_offsets"])
        parts = over_ranges(
            lambda start, stop: self._views_of(per_point, start, stop), self.num_images, np.diff(self.offsets)
        )
        return np.concatenate([np.empty(0, dtype=np.int64), *parts])

    def _views_of(self, per_point: IntArray, start: int, stop: int) -> IntArray:
        ends = self.offsets[start : stop + 1]
        views = per_point.take(self.arrays["point_idx"][ends[0] : ends[-1]])
        return np.asarray(np.diff(np.concatenate([[0], np.cumsum(views)])[ends - ends[0]]))

    @cached_property
    def repeats_follow(self) -> bool:
        """Whether rows of an image that show one point follow each other."""
        point, image = self.arrays["point_idx"], self.arrays["image_idx"]
        again = (point[1:] == point[:-1]) & (image[1:] == image[:-1])
        return bool(np.count_nonzero(again) == np.count_nonzero(~self.is_first))


@dataclass(frozen=True, slots=True, eq=False)
class JointArrays:
    """A joint system as the kernels see it; see `sfm_audit.audit.joint.observations.JointObservations`.

    design: (n, 2, C).    left_px: (n, 2).    weight: (n,).    inverse: (P, 3, 3).
    extra: by image, its included fields (n_i, 2, r).
    """

    index: JointIndex
    design: FloatArray
    left_px: FloatArray
    weight: FloatArray
    inverse: FloatArray
    extra: dict[int, FloatArray]


class JointSums:
    """Sums over the views of a joint system; several threads may ask at once."""

    def __init__(self, arrays: JointArrays) -> None:
        self.index = index = arrays.index
        num_images, num_rows, num_points = index.num_images, index.num_rows, index.num_points
        first = np.full(num_images, -1, dtype=np.int64)
        width = np.zeros(num_images, dtype=np.int64)
        parts: list[FloatArray] = []
        for image, fields in sorted(arrays.extra.items()):
            first[image], width[image] = sum(part.size for part in parts), fields.shape[2]
            parts.append(np.ascontiguousarray(fields))
        extra = np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(1)
        held: dict[str, Any] = {
            **index.arrays,
            "design": doubles(arrays.design, (num_rows, 2, arrays.design.shape[2])),
            "weight": doubles(arrays.weight, (num_rows,)),
            "left": doubles(arrays.left_px, (num_rows, 2)),
            "point_inverse": doubles(arrays.inverse, (num_points, 3, 3)),
            "extra_first": first,
            "extra_width": width,
            "extra": extra,
        }
        self._held = held
        self.width = int(arrays.design.shape[2])
        self._model = _Model(num_images, self.width, *(held[name].ctypes.data for name in _ARRAYS))
        self._model.held = held  # whoever keeps the addresses keeps the arrays
        self._num_images = num_images

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
        return self.index.repeats_follow

    @property
    def extra_widths(self) -> IntArray:
        """(I,) how many included fields each image has."""
        widths: IntArray = self._held["extra_width"]
        return widths

    def most_of(self, images: IntArray) -> tuple[int, int, int, int]:
        """Return the most rows, views of points and columns around that one of some images has; those of the widest."""
        counts, views = np.diff(self.index.offsets)[images], int(self.index.num_views[images].max(initial=0))
        most = min(views, self._num_images)
        columns = most * self.width + int(np.sort(self.extra_widths)[self._num_images - most :].sum())
        return int(counts.max(initial=0)), views, columns, self.width + int(self.extra_widths.max(initial=0))

    def most_around(self, images: IntArray) -> int:
        """Return how many images at most see points that one of some images sees."""
        return int(np.minimum(self.index.num_views[images], self._num_images).max(initial=0))

    def can(self, image_idx: int) -> bool:
        """Whether the views of an image's points are few enough to be held at once."""
        return bool(self.index.num_views[image_idx] <= _MOST_VIEWS)

    def off_points(self, values_px: FloatArray) -> FloatArray:
        """Return (P, 3) V^-1 J^T w values, and take what that removes off the values (n, 2), in place."""
        function = kernel("joint_off_points", _ModelPointer, Doubles, Doubles, Size, Doubles, Doubles)
        if function is None or values_px.shape != self._held["left"].shape or not values_px.flags.c_contiguous:
            raise ValueError("values of other observations, or no kernels")
        weight, inverse = self._held["weight"], self._held["point_inverse"]
        steps = np.empty((len(inverse), 3))
        function(ctypes.byref(self._model), weight, inverse, len(inverse), values_px, steps)
        return steps

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
