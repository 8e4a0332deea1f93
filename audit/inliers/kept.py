"""What is kept of the inliers of all images, while one image after the other is projected."""

from __future__ import annotations

from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from sfm_audit.audit.cameras import is_fisheye
from sfm_audit.audit.inliers.sanity import params_of, usable_cameras
from sfm_audit.audit.inliers.small import SmallImages, groups, project_small
from sfm_audit.audit.inliers.stationarity import offsets_of_sums
from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.projection import LENSES, NO_LENS, NUM_PARAMS, Projected, Scene, project_scene
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray, distinct
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import SparseModel

_INLIERS, _DANGLING, _BEHIND, _NONFINITE, _UNPROJECTED = range(5)
_NUM_COUNTS: Final = 5
_TOO_MANY: Final = 1 << 31  # for rows of 32 bits; their derivatives alone would take 100 GB
_Number = TypeVar("_Number", bound=np.number[Any])


class Kept:
    """Inliers of each image from its first linked observation on, and how many there are; `pack` closes the gaps.

    Attributes
    ----------
    scene : as `project_scene` got it
    missing : (m,) images that are to be `put` here
    d_extra : of the images that were put here, (e, 2, n) derivatives in the distortion
    unsure : (u,) images that are here without their pose's offset
    pose_offset_px : (I,) NaN where it is not known
    pose_sums : (I, 6, 6) and (I, 6), see `stationarity.offsets_of_sums`; None where not all images have them
    """

    def __init__(self, model: SparseModel) -> None:
        num_images, capacity = len(model.images), len(model.observations)
        if capacity >= _TOO_MANY:
            raise ValueError(f"expected fewer than 2^31 observations, found {capacity}")
        self._first = model.observations.offsets
        self.pose_offset_px: FloatArray = np.full(num_images, np.nan)
        self.d_extra: dict[int, FloatArray] = {}
        self._counts = np.zeros((_NUM_COUNTS, num_images), dtype=np.int64)
        self.missing: IntArray = np.arange(num_images)
        self.unsure: IntArray = np.empty(0, dtype=np.int64)
        self.pose_sums: tuple[FloatArray, FloatArray] | None = None
        self.scene = scene_of(model)
        found = project_scene(self.scene)
        if found is None:
            self.rows: Int32Array = np.empty(capacity, dtype=np.int32)
            self.residuals_px, self.point_jacobian = np.empty((2, capacity)), np.empty((2, 3, capacity))
        else:
            self.rows, self.residuals_px, self.point_jacobian = found.rows, found.residuals_px, found.point_jacobian
            self._take(found, np.diff(self._first))
        small = [each for images in groups(model, self.missing) if (each := project_small(model, images)) is not None]
        for each in small:
            self._take_small(each)
        taken = np.concatenate([np.empty(0, dtype=np.int64), *(each.images for each in small)])
        self.missing = np.setdiff1d(self.missing, taken, assume_unique=True)

    def _take(self, found: Projected, num_linked: IntArray) -> None:
        """Book the images that are done."""
        counts = found.counts.T * found.done
        self._counts[: len(counts)] = counts
        self._counts[_NONFINITE] = (num_linked - counts.sum(axis=0)) * found.done
        self.missing = np.flatnonzero(~found.done)
        self.pose_sums = (found.pose_gram, found.pose_right) if found.done.all() else None
        num = counts[_INLIERS]
        offsets, is_sure = offsets_of_sums(found.pose_gram, found.pose_right, num)
        self.pose_offset_px[:] = np.where(found.done & is_sure, offsets, np.nan)
        self.unsure = np.flatnonzero(found.done & ~is_sure & (num > 0))

    def _take_small(self, found: SmallImages) -> None:
        """Book small images of one camera, all of whose observations are inliers."""
        self.rows[found.rows] = found.rows
        self.residuals_px[:, found.rows] = found.residuals_px
        self.point_jacobian[:, :, found.rows] = found.point_jacobian
        images, num = found.images, np.diff(found.offsets)
        for image_idx, start, count in zip(images.tolist(), found.offsets.tolist(), num.tolist(), strict=False):
            self.d_extra[image_idx] = found.d_extra[:, :, start : start + count]
        self._counts[_INLIERS, images] = num
        offsets, is_sure = offsets_of_sums(found.pose_gram, found.pose_right, num)
        self.pose_offset_px[images] = np.where(is_sure, offsets, np.nan)
        self.unsure = np.concatenate([self.unsure, images[~is_sure]])

    def put(
        self,
        image_idx: int,
        inlier_row: IntArray,
        residuals_px: FloatArray,
        point_jacobian: FloatArray,
        d_extra: FloatArray,
    ) -> None:
        """Keep the inliers (n,) of an image, given as rows of its linked observations."""
        first = int(self._first[image_idx])
        own = slice(first, first + inlier_row.size)
        self.rows[own] = inlier_row + first
        self.residuals_px[:, own] = residuals_px
        self.point_jacobian[:, :, own] = point_jacobian
        self.d_extra[image_idx] = d_extra
        self._counts[_INLIERS, image_idx] = inlier_row.size

    def count(self, image_idx: int, *, dangling: int, behind: int, nonfinite: int, unprojected: int) -> None:
        """Keep how many linked observations are no inliers, by cause."""
        self._counts[_DANGLING:, image_idx] = dangling, behind, nonfinite, unprojected

    @property
    def others(self) -> IntArray:
        """(4, I): dangling, behind, not finite, and of these not projected."""
        return self._counts[_DANGLING:]

    def pack(self) -> IntArray:
        """Close the gaps between images, in place, and return (I + 1,) where each image begins."""
        num = self._counts[_INLIERS]
        offsets = np.zeros(len(num) + 1, dtype=np.int64)
        np.cumsum(num, out=offsets[1:])
        if offsets[-1] != len(self.rows):
            images = np.flatnonzero(num)
            moves = list(zip(self._first[images].tolist(), offsets[images].tolist(), num[images].tolist(), strict=True))
            self.rows = _packed(self.rows, moves, int(offsets[-1]))
            self.residuals_px = _packed(self.residuals_px, moves, int(offsets[-1]))
            self.point_jacobian = _packed(self.point_jacobian, moves, int(offsets[-1]))
        return offsets


def _packed(array: npt.NDArray[_Number], moves: list[tuple[int, int, int]], total: int) -> npt.NDArray[_Number]:
    """Move pieces (from, to, length) of the last axis to the front; contiguous, in the memory of ``array``."""
    capacity, flat = array.shape[-1], array.reshape(-1)
    num_rows = flat.size // capacity
    for row in range(num_rows):
        for start, to, length in moves:
            at, target = row * capacity + start, row * total + to
            if at != target:
                flat[target : target + length] = flat[at : at + length]
    return flat[: num_rows * total].reshape(*array.shape[:-1], total)


def scene_of(model: SparseModel) -> Scene:
    """Return the observations, poses and cameras of a model as arrays."""
    observations, images, cameras = model.observations, model.images, model.cameras
    lenses, params = np.zeros((len(cameras), 3), dtype=np.int64), np.zeros((len(cameras), NUM_PARAMS))
    lenses[:, 0], is_usable = NO_LENS, usable_cameras(cameras)
    for model_id in distinct(cameras.model_id).tolist():
        lens = BY_ID[model_id]
        if lens.name not in LENSES:
            continue
        rows = np.flatnonzero((cameras.model_id == model_id) & is_usable)
        if not len(rows):
            continue
        focals, centre, extra = lens.focal_idxs, lens.principal_point_idxs, lens.extra_idxs
        chosen = [focals[0], focals[-1], *centre, *extra]
        params[rows, : len(chosen)] = params_of(cameras, rows)[:, chosen]
        lenses[rows] = LENSES[lens.name], is_fisheye(lens), len(extra)
    return Scene(
        observations.offsets,
        small_ints(observations.point_idx, len(observations)),
        np.ascontiguousarray(observations.xy_px),
        np.ascontiguousarray(model.points.xyz_world),
        np.ascontiguousarray(images.quat_cam_from_world_wxyz),
        np.ascontiguousarray(images.translation_cam_from_world),
        images.camera_idx,
        lenses,
        params,
    )
