"""Median depths of the points that images see in a joint system: `joint_depths.c`."""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints
from sfm_audit.audit.kernels.joint import DONE, JointIndex
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import FloatArray, IntArray


def median_depths(
    index: JointIndex,
    images: IntArray,
    points: IntArray,
    xyz_world: FloatArray,
    poses: tuple[FloatArray, FloatArray],
) -> FloatArray | None:
    """Return (k,) median depths of some images, model units, NaN without observations; None where numpy has to say it.

    Parameters
    ----------
    index : who sees what        points : (P,) rows of ``xyz_world`` (R, 3)
    poses : quaternions w x y z (I, 4) and translations (I, 3), cam_from_world
    """
    function = kernel("joint_depths", Size, Ints, Ints, SmallInts, Ints, Doubles, Size, *([Doubles] * 3))
    if function is None:
        return None
    if images.size and not (images.min() >= 0 and images.max() < index.num_images):
        raise ValueError(f"images: expected 0 .. {index.num_images - 1}")
    world = doubles(xyz_world, (len(xyz_world), 3))
    moves = tuple(doubles(each, (index.num_images, size)) for each, size in zip(poses, (4, 3), strict=True))
    out, asked = np.empty(len(images)), ints(images, len(images))
    given = index.offsets, index.arrays["point_idx"], ints(points, index.num_points), world, len(world), *moves
    return out if function(len(asked), asked, *given, out) == DONE else None
