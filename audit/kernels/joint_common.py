"""Candidate fields that many images have in common, by passes over the observations (`joint_common.c`)."""

from __future__ import annotations

import ctypes
from typing import Any, Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints
from sfm_audit.audit.kernels.joint import DONE, FIELDS, JointSums
from sfm_audit.audit.kernels.joint_scores import Asked, SeenArrays, seen_points
from sfm_audit.audit.kernels.library import Bytes, Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import BoolArray, FloatArray

COMMON: Final = 8
"""Most fields at once."""
_FACTS: Final = 27


class CommonGram(NamedTuple):
    """E^T w O E of c fields E, one unknown each; O takes values off the points.

    absorbed: (P, 3, 4 or 8) V^-1 J^T w E.    gram: (c, c).    sq_length, score: (c,) E^T w E and E^T w y~.
    is_seen: (P,) whether an image with the fields sees a point.
    """

    absorbed: FloatArray
    gram: FloatArray
    sq_length: FloatArray
    score: FloatArray
    is_seen: BoolArray


class _Fields(ctypes.Structure):
    """`common_fields` of joint_common.c."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("facts", "is_fisheye", "power", "made_of"))


class CommonFields:
    """Asks about fields that some images have in common.

    Parameters
    ----------
    asked : the images, each once; without facts (0, 27) the fields are made of 1 along x and along y alone
    made_of : (44, c) of which functions, c <= 8, see `sfm_audit.audit.joint.image_scores`
    """

    def __init__(self, sums: JointSums, seen: SeenArrays, asked: Asked, made_of: FloatArray) -> None:
        self._sums, self._num_fields = sums, made_of.shape[1]
        held: list[object] = []
        self._seen = seen_points(seen, sums, held)
        count = len(asked.images)
        images = ints(asked.images, count)
        if count and not (images.min() >= 0 and images.max() < sums.num_images):
            raise ValueError(f"images: expected 0 .. {sums.num_images - 1}")
        self._halves = 1 if 2 * self._num_fields <= COMMON else 2
        self._width = self._halves * COMMON // 2
        padded = np.zeros((FIELDS, self._width))
        padded[:, : self._num_fields] = made_of
        has_facts = len(asked.facts) > 0 or not count
        facts = doubles(asked.facts, (count if has_facts else 0, _FACTS))
        lens = ints(asked.is_fisheye, len(facts)), ints(asked.power, len(facts))
        self._images, self._arrays = images, (facts, *lens, padded)
        given = (*(each.ctypes.data for each in self._arrays[:3]),) if has_facts else (None,) * 3
        self._fields = _Fields(*given, padded.ctypes.data)
        self._seen.held, self._fields.held = held, self._arrays  # whoever keeps the addresses keeps the arrays
        self._is_own = np.full(sums.num_images, -1, dtype=np.int64)
        self._is_own[images] = np.arange(count)

    def _model(self) -> tuple[Any, Any, Any]:
        return ctypes.byref(self._sums.model), ctypes.byref(self._seen), ctypes.byref(self._fields)

    def gram(self) -> CommonGram | None:
        """Return the sums of the fields among themselves; None for the numpy path."""
        function = kernel("joint_common_gram", Size, *_MODEL, Size, Size, Ints, *([Doubles] * 4), Bytes)
        if function is None:
            return None
        num_points, count = self._sums.num_points, self._num_fields
        absorbed, gram = np.empty((num_points, 3, self._width)), np.empty((self._width, self._width))
        length, score = np.empty((2, self._width))
        is_seen = np.empty(num_points, dtype=np.uint8)
        given = num_points, len(self._images), self._images
        if function(self._halves, *self._model(), *given, absorbed, gram, length, score, is_seen) != DONE:
            return None
        return CommonGram(absorbed, gram[:count, :count], length[:count], score[:count], is_seen.astype(bool))

    def right(self, absorbed: FloatArray) -> FloatArray | None:
        """(I, C, c) design^T w O E, by image; ``absorbed`` of `gram`."""
        function = kernel("joint_common_right", Size, *_MODEL, Ints, Doubles, Doubles)
        out = np.empty((self._sums.num_images, self._sums.width, self._width))
        given = doubles(absorbed, (self._sums.num_points, 3, self._width))
        if function is None or function(self._halves, *self._model(), self._is_own, given, out) != DONE:
            return None
        return out[:, :, : self._num_fields]

    def track_scores(self, moved: FloatArray) -> FloatArray | None:
        """(P, c) sum over the views of each point of w y~^T (E - N B); ``moved`` (I, C, c): T B of each image."""
        function = kernel("joint_common_tracks", Size, *_MODEL, Size, Ints, Doubles, Doubles)
        num_points = self._sums.num_points
        padded = np.zeros((self._sums.num_images, self._sums.width, self._width))
        padded[:, :, : self._num_fields] = moved
        out = np.empty((num_points, self._width))
        given = num_points, self._is_own, padded
        return (
            out[:, : self._num_fields]
            if function is not None and function(self._halves, *self._model(), *given, out) == DONE
            else None
        )


_MODEL: Final = (ctypes.c_void_p,) * 3
