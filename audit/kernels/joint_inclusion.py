"""What fields that become free do to all residuals of a joint system: `joint_inclusion.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Final

import numpy as np

from sfm_audit.audit.kernels.checked import doubles
from sfm_audit.audit.kernels.joint import DONE, JointSums
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import FloatArray

_NONE: Final = -1


def take_change(
    sums: JointSums, moved: FloatArray, fields: Mapping[int, FloatArray], point_step: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return (P, 3) steps of the points and (n, 2) residuals off the points after a step; None without kernels.

    Parameters
    ----------
    sums : over the residuals off the points as they were        point_step : (P, 3) as they were
    moved : (I, C) T change of each image        fields : by image, (n_i, 2) px by which its included fields change
    """
    function = kernel("joint_take_change", ctypes.c_void_p, Size, Doubles, Ints, *([Doubles] * 5))
    if function is None:
        return None
    index = sums.index
    counts = np.diff(index.offsets)
    first, parts, size = np.full(sums.num_images, _NONE, dtype=np.int64), [np.zeros((1, 2))], 1
    for image, values in fields.items():
        parts.append(doubles(values, (int(counts[image]), 2)))
        first[image], size = size, size + len(values)
    room = np.empty(2 * int(np.diff(index.arrays["point_offsets"]).max(initial=0)) + 1)
    given = doubles(moved, (sums.num_images, sums.width)), first, np.concatenate(parts)
    left, steps = np.empty((sums.num_rows, 2)), np.empty((sums.num_points, 3))
    before = doubles(point_step, steps.shape)
    status = function(ctypes.byref(sums.model), sums.num_points, *given, before, room, left, steps)
    return (steps, left) if status == DONE else None
