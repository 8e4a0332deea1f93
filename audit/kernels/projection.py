"""All observations of a model projected, with derivatives, in one call; twin of `audit.inliers.residuals`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

LENSES: Final[dict[str, int]] = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 0,
    "SIMPLE_FISHEYE": 0,
    "FISHEYE": 0,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 1,
    "RADIAL_3": 1,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 1,
    "OPENCV_FISHEYE": 1,
    "SIMPLE_OPENCV_FISHEYE": 1,
    "OPENCV": 2,
    "FULL_OPENCV": 3,
    "BROWN": 4,
    "SIMPLE_BROWN": 4,
    "FOV": 5,
    "THIN_PRISM_FISHEYE": 6,
    "RAD_TAN_THIN_PRISM_FISHEYE": 7,
    "SIMPLE_DIVISION": 8,
    "DIVISION": 8,
    "EUCM": 9,
}
"""Camera models that are compiled, and what the C source calls their distortion; others are projected by numpy."""
NO_LENS: Final = -1
NUM_PARAMS: Final = 16
"""Numbers of a camera: fx fy cx cy and up to twelve of its distortion."""
NUM_POSE: Final = 6
NUM_SUMS: Final = 27
NUM_COUNTS: Final = 3
_MOST_LOOKED_AT: Final = 2  # times the inliers of images that are looked at together


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What is projected; every array C-contiguous.

    offsets: (I + 1,), point_idx: (M,), xy_px: (M, 2): the linked observations by image; -1 = dangling.
    xyz_world: (P, 3).    quaternions, translations: (I, 4), (I, 3) cam_from_world.    camera_idx: (I,), -1 = none.
    lenses: (C, 3) value of `LENSES` or NO_LENS, whether it is a fisheye model, number of distortion parameters.
    params: (C, 16) fx fy cx cy, distortion.
    """

    offsets: IntArray
    point_idx: Int32Array
    xy_px: FloatArray
    xyz_world: FloatArray
    quaternions: FloatArray
    translations: FloatArray
    camera_idx: IntArray
    lenses: IntArray
    params: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
    """Inliers of each image from its first observation on; what lies between two images' is undefined.

    rows: (M,) rows of the observations.    residuals_px: (2, M).    point_jacobian: (2, 3, M) world frame.
    counts: (I, 3) inliers, dangling, behind.    done: (I,) whether the image is here at all.
    pose_gram: (I, 6, 6) products of the columns of each pose.    pose_right: (I, 6) of these and the residuals.
    """

    rows: Int32Array
    residuals_px: FloatArray
    point_jacobian: FloatArray
    counts: IntArray
    pose_gram: FloatArray
    pose_right: FloatArray
    done: BoolArray


def project_scene(scene: Scene) -> Projected | None:
    """Project all images of a model; None for the numpy path.

    Raises
    ------
    IndexError
        where an index or an offset does not fit its table.
    """
    function = kernel(
        "sfm_project",
        *(Size, Size, Ints, SmallInts, Doubles, Doubles, Doubles, Doubles, Ints, Ints, Doubles),
        *(Size, SmallInts, Doubles, Doubles, Ints, Doubles, Ints),
    )
    if function is None:
        return None
    _check(scene)
    num_images, capacity = len(scene.camera_idx), len(scene.point_idx)
    num_linked = np.diff(scene.offsets)
    rows, status = np.empty(capacity, dtype=np.int32), np.empty(num_images, dtype=np.int64)
    residuals, jacobian = np.empty((2, capacity)), np.empty((2, 3, capacity))
    counts, sums = np.zeros((num_images, NUM_COUNTS), dtype=np.int64), np.zeros((num_images, NUM_SUMS))
    arrays = (
        *(scene.offsets, scene.point_idx, scene.xy_px, scene.xyz_world, scene.quaternions, scene.translations),
        *(scene.camera_idx, scene.lenses, scene.params),
        *(capacity, rows, residuals, jacobian, counts, sums, status),
    )
    over_ranges(lambda start, stop: function(start, stop, *arrays), num_images, num_linked)
    gram, right = _unpacked(sums)
    return Projected(rows, residuals, jacobian, counts, gram, right, status == 0)


def distortion_derivatives(
    scene: Scene, offsets: IntArray, point_idx: Int32Array, image_idxs: IntArray
) -> list[FloatArray] | None:
    """Return (e, 2, n) d projection / d distortion of the inliers of some images, px per unit; None for the numpy path.

    Those of images beside each other in ``image_idxs`` are beside each other in memory. (0, 2, 0) without inliers.

    Parameters
    ----------
    offsets, point_idx : (I + 1,), (n,) the inliers of all images; a point of the scene each
    image_idxs : (k,) images that `project_scene` has done

    Raises
    ------
    IndexError
        where an image has no lens, or an index or an offset does not fit its table.
    """
    types = (Size, Ints, Ints, SmallInts, Doubles, Doubles, Doubles, Ints, Ints, Doubles, Ints, Doubles)
    function = kernel("sfm_distortion", *types)
    if function is None:
        return None
    camera_idx = scene.camera_idx
    _check_inliers(scene, offsets, point_idx, image_idxs)
    num, num_extra = offsets[image_idxs + 1] - offsets[image_idxs], scene.lenses[camera_idx[image_idxs], 2]
    ends = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(2 * num_extra * num)])
    extra = np.empty(int(ends[-1]))
    arrays = scene.xyz_world, scene.quaternions, scene.translations, camera_idx, scene.lenses, scene.params
    if function(len(num), image_idxs, offsets, point_idx, *arrays, ends[:-1].copy(), extra):
        return None
    shapes = zip(ends.tolist(), ends[1:].tolist(), num_extra.tolist(), num.tolist(), strict=False)
    return [extra[start:stop].reshape(size if count else 0, 2, count) for start, stop, size, count in shapes]


def _check_inliers(scene: Scene, offsets: IntArray, point_idx: Int32Array, image_idxs: IntArray) -> None:
    """Every index that C follows for these images lies within its table; what `_check` has seen is not looked at."""
    num_images = len(scene.camera_idx)
    if offsets.shape != (num_images + 1,) or not image_idxs.size:
        raise IndexError("expected images, and offsets of all images")
    if not 0 <= image_idxs.min() <= image_idxs.max() < num_images or scene.camera_idx[image_idxs].min() < 0:
        raise IndexError("an image is not there, or has no camera")
    if scene.lenses[scene.camera_idx[image_idxs], 0].min() < 0:
        raise IndexError("an image has no lens that is compiled")
    first, last = offsets[image_idxs], offsets[image_idxs + 1]
    if not (first.min() >= 0 and (first <= last).all() and last.max() <= len(point_idx)):
        raise IndexError("an offset of the inliers points outside of their table")
    together = last.max() - first.min() <= _MOST_LOOKED_AT * (last - first).sum()
    parts = [(first.min(), last.max())] if together else zip(first, last, strict=True)
    for start, stop in parts:
        own = point_idx[start:stop]
        if own.size and not 0 <= own.min() <= own.max() < len(scene.xyz_world):
            raise IndexError("an inlier is of a point that is not there")


def _unpacked(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gram matrices (I, 6, 6) and right-hand sides (I, 6) of what the kernel sums."""
    gram, right = np.empty((len(sums), NUM_POSE, NUM_POSE)), np.empty((len(sums), NUM_POSE))
    at = 0
    for row in range(NUM_POSE):
        width = NUM_POSE - row
        gram[:, row, row:] = gram[:, row:, row] = sums[:, at : at + width]
        right[:, row] = sums[:, at + width]
        at += width + 1
    return gram, right


def _check(scene: Scene) -> None:
    """Every index that C follows lies within its table."""
    num_images, num_linked, num_cameras = len(scene.camera_idx), len(scene.point_idx), len(scene.lenses)
    shapes = (
        scene.offsets.shape == (num_images + 1,),
        scene.xy_px.shape == (num_linked, 2),
        scene.xyz_world.ndim == 2 and scene.xyz_world.shape[1] == 3,
        scene.quaternions.shape == (num_images, 4),
        scene.translations.shape == (num_images, 3),
        scene.lenses.shape == (num_cameras, 3),
        scene.params.shape == (num_cameras, NUM_PARAMS),
    )
    in_range = (
        scene.offsets[0] == 0 and scene.offsets[-1] == num_linked and bool((np.diff(scene.offsets) >= 0).all()),
        scene.point_idx.max(initial=-1) < len(scene.xyz_world),
        scene.camera_idx.max(initial=-1) < num_cameras,
        bool((scene.lenses[:, 0] < len(LENSES)).all() and (scene.lenses[:, 2] <= NUM_PARAMS - 4).all()),
        bool((scene.lenses[:, 2] >= 0).all()),
    )
    if not all(shapes) or not all(in_range):
        raise IndexError("an offset or an index of the model points outside of its table")
