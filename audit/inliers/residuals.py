"""Which observations are inliers, and what is left of each after projection (method.md section 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import project_columns
from sfm_audit.audit.inliers.distortion import DistortionDerivatives, Projectable
from sfm_audit.audit.inliers.frames import claimed_frames, frame_offsets_px
from sfm_audit.audit.inliers.kept import Kept
from sfm_audit.audit.inliers.sanity import (
    MAX_RESIDUAL_PX,
    are_differentiable,
    are_sane,
    is_differentiable,
    is_sane,
    is_usable,
)
from sfm_audit.audit.inliers.stationarity import pose_offset_px, pose_offsets_px
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, Int32Array, IntArray
from sfm_audit.loaders.model import CameraRecord, ImageRecord, SparseModel, rotation_from_quat

_MAX_JOINED: Final = 64
_MAX_WAITING: Final = 128


@dataclass(frozen=True, slots=True, eq=False)
class ImageResiduals:
    """The inliers among the linked points of one image, projected.

    inlier_row: (n,) their rows among the points given.          residuals_px: (2, n) observed - projected.
    jacobian_cam: (2, 3, n) d projection / d point in the camera frame, px per model unit.      xyz_cam: (n, 3).
    d_extra: (e, 2, n) d projection / d distortion parameters, px per unit.
    num_dangling, num_behind, num_nonfinite: points that are no inliers, by cause.
    num_unprojected: of num_nonfinite, those in front of the camera that have no finite projection.
    """

    inlier_row: IntArray
    residuals_px: FloatArray
    jacobian_cam: FloatArray
    xyz_cam: FloatArray
    d_extra: FloatArray
    num_dangling: int
    num_behind: int
    num_nonfinite: int
    num_unprojected: int

    @property
    def pose_offset_px(self) -> float:
        """RMS residual that moving the pose alone would remove (method.md section 6), NaN without inliers."""
        return pose_offset_px(self.residuals_px, self.jacobian_cam, self.xyz_cam)


@dataclass(frozen=True, slots=True, eq=False)
class ModelResiduals:
    """The inliers of all images of a model, by image in ImageTable order, then by POINTS2D order.

    offsets: (I + 1,) image i owns columns offsets[i]:offsets[i + 1].    observation_row: (n,) rows of ObservationTable.
    point_idx: (n,) rows of PointTable.                                  residuals_px: (2, n) observed - projected.
    point_jacobian: (2, 3, n) px per model unit, world frame.            pose_offset_px: (I,) NaN without inliers;
    of the whole frame where the model claims frames of several images.
    d_extra: by image, (e, 2, n_i) d projection / d distortion parameters, px per unit. With them everything else that
    a projection gives is cheap to have again: `audit.inliers.projected.image_inliers`.
    num_dangling, num_behind, num_nonfinite: (I,) linked observations that are no inliers, by cause.
    num_unprojected: (I,) of num_nonfinite, those in front of their camera that have no finite projection.
    """

    offsets: IntArray
    observation_row: Int32Array
    point_idx: Int32Array
    residuals_px: FloatArray
    point_jacobian: FloatArray
    pose_offset_px: FloatArray
    d_extra: DistortionDerivatives
    num_dangling: IntArray
    num_behind: IntArray
    num_nonfinite: IntArray
    num_unprojected: IntArray

    def rows(self, image_idx: int) -> slice:
        """Columns of the image in row ``image_idx`` of the image table."""
        return slice(int(self.offsets[image_idx]), int(self.offsets[image_idx + 1]))


def image_residuals(
    image: ImageRecord, xy_px: FloatArray, xyz_world: FloatArray, point_idx: IndexArray
) -> ImageResiduals:
    """Project the linked points of one image and keep those that can be audited.

    Parameters
    ----------
    image : pose and camera; without a camera nothing is projected and all count as not finite
    xy_px : (m, 2) observed, distorted px        xyz_world : (m, 3), rows of dangling points are ignored
    point_idx : (m,) rows of the point table, -1 = dangling

    Notes
    -----
    method.md section 1: an observation enters if its point exists, Zc > 0 (spherical cameras: Xc != 0) and its
    projection is finite. Observations that are themselves not finite count as not finite, and so does what is finite
    and beyond arithmetic (`audit.inliers.sanity`).
    """
    linked = point_idx >= 0
    num_dangling = linked.size - int(np.count_nonzero(linked))
    camera = image.camera
    with np.errstate(all="ignore"):
        xyz_cam = image.cam_from_world(xyz_world)
        usable = camera is not None and is_usable(camera)
        finite = linked & usable & _sane_rows(xyz_cam) & _sane_rows(xy_px)
        spherical = camera is not None and camera.model.is_spherical
        candidate = finite & ((xyz_cam != 0).any(axis=1) if spherical else xyz_cam[:, 2] > 0)
        num_behind = int(np.count_nonzero(finite)) - int(np.count_nonzero(candidate))
        residuals, jacobian, d_extra = np.empty((2, 0)), np.empty((2, 3, 0)), np.empty((0, 2, 0))
        rows = np.flatnonzero(candidate)
        if camera is not None and rows.size:
            all_in = rows.size == linked.size
            xyz_cam = xyz_cam if all_in else xyz_cam[rows]
            residuals, jacobian, d_extra = _residuals(camera, xy_px if all_in else xy_px[rows], xyz_cam)
        valid = _valid(residuals, jacobian, xyz_cam)
    num_unprojected = 0
    if valid is not None:
        num_unprojected = valid.size - int(np.count_nonzero(valid))
        rows, xyz_cam = rows[valid], xyz_cam[valid]
        residuals, jacobian, d_extra = residuals[:, valid], jacobian[:, :, valid], d_extra[:, :, valid]
    return ImageResiduals(
        rows,
        residuals,
        jacobian,
        xyz_cam if rows.size else np.empty((0, 3)),
        d_extra,
        num_dangling,
        num_behind,
        linked.size - num_dangling - num_behind - rows.size,
        num_unprojected,
    )


def _sane_rows(rows: FloatArray) -> BoolArray | np.bool_:
    """Whether the numbers of each row are sane, (n,); True for all where the largest tells it."""
    return np.True_ if are_sane(rows) else is_sane(rows).all(axis=1)


def _valid(residuals_px: FloatArray, jacobian_cam: FloatArray, xyz_cam: FloatArray) -> BoolArray | None:
    """Which projections (n,) can be calculated with; None where all can, which one look at the largest tells."""
    is_small = np.abs(residuals_px).max(initial=0.0) <= MAX_RESIDUAL_PX  # false with NaN
    if is_small and (not residuals_px.size or are_differentiable(jacobian_cam, xyz_cam)):
        return None
    valid = (np.abs(residuals_px) <= MAX_RESIDUAL_PX).all(axis=0)
    valid &= is_differentiable(jacobian_cam, xyz_cam) | ~np.isfinite(jacobian_cam).all(axis=(0, 1))  # panoramas' poles
    return None if valid.all() else valid


def _residuals(
    camera: CameraRecord, xy_px: FloatArray, xyz_cam: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Observed minus projected (2, n), its Jacobians (2, 3, n) in the camera frame and (e, 2, n) in the distortion."""
    extras = list(camera.model.extra_idxs)
    projection = project_columns(camera.model, camera.params, xyz_cam, with_params=bool(extras))
    d_params = projection.d_xy_d_params
    d_extra = np.empty((0, 2, len(xyz_cam))) if d_params is None else d_params[extras]
    residuals = np.subtract(xy_px.T, projection.xy_px, order="C")
    if camera.model.is_spherical:
        residuals[0] -= camera.width * np.round(residuals[0] / camera.width)  # the seam is no edge
    return residuals, projection.d_xy_d_cam, d_extra


def _points_of(model: SparseModel, point_idx: IndexArray) -> FloatArray:
    """(m, 3) world points; NaN where dangling."""
    if not len(model.points):
        return np.full((len(point_idx), 3), np.nan)
    xyz = model.points.xyz_world.take(point_idx, axis=0, mode="wrap")
    dangling: BoolArray = point_idx < 0
    if dangling.any():
        xyz[dangling] = np.nan
    return xyz


def longest_px(residuals_px: FloatArray) -> float:
    """Return the length of the longest residual of (2, n), 0 without any."""
    return float(np.sqrt((residuals_px**2).sum(axis=0).max(initial=0.0)))


class _PoseOffsets:
    """Takes the pose offsets of small images of one size together, of others at once."""

    def __init__(self, offset_px: FloatArray) -> None:
        self._offset_px = offset_px
        self._waiting: dict[int, list[tuple[int, ImageResiduals]]] = {}

    def add(self, image_idx: int, part: ImageResiduals) -> None:
        """Take an image."""
        size = part.inlier_row.size
        if not 0 < size <= _MAX_JOINED:
            self._offset_px[image_idx] = part.pose_offset_px
            return
        alike = self._waiting.setdefault(size, [])
        alike.append((image_idx, part))
        if len(alike) == _MAX_WAITING:
            self._ask(self._waiting.pop(size))

    def flush(self) -> None:
        """Take what is left."""
        for alike in self._waiting.values():
            self._ask(alike)
        self._waiting.clear()

    def _ask(self, alike: list[tuple[int, ImageResiduals]]) -> None:
        parts = [(part.residuals_px, part.jacobian_cam, part.xyz_cam) for _, part in alike]
        with np.errstate(all="ignore"):
            self._offset_px[[image_idx for image_idx, _ in alike]] = pose_offsets_px(parts)


def model_residuals(model: SparseModel) -> ModelResiduals:
    """Return the inliers of all images with their residuals; arrays throughout, each observation projected once."""
    observations = model.observations
    kept = Kept(model)
    waiting = _PoseOffsets(kept.pose_offset_px)
    rotations = rotation_from_quat(model.images.quat_cam_from_world_wxyz)
    for image_idx in kept.missing.tolist():
        part = _part_of(model, image_idx)
        kept.put(
            image_idx, part.inlier_row, part.residuals_px, rotations[image_idx].T @ part.jacobian_cam, part.d_extra
        )
        kept.count(
            image_idx,
            dangling=part.num_dangling,
            behind=part.num_behind,
            nonfinite=part.num_nonfinite,
            unprojected=part.num_unprojected,
        )
        waiting.add(image_idx, part)
    for image_idx in kept.unsure.tolist():
        waiting.add(image_idx, _part_of(model, image_idx))
    waiting.flush()
    offsets, pose_offset = kept.pack(), kept.pose_offset_px
    all_in = len(kept.rows) == len(observations)
    point_idx = (observations.point_idx if all_in else observations.point_idx[kept.rows]).astype(np.int32, copy=False)
    if (frames := claimed_frames(model)) is not None:
        on_points = (kept.residuals_px, kept.point_jacobian)
        pose_offset = frame_offsets_px(model, frames, offsets, point_idx, on_points, sums=kept.pose_sums)
    return ModelResiduals(
        offsets,
        kept.rows,
        point_idx,
        kept.residuals_px,
        kept.point_jacobian,
        pose_offset,
        DistortionDerivatives(kept.d_extra, Projectable(model, kept.scene, offsets, point_idx), len(model.images)),
        *kept.others,
    )


def _part_of(model: SparseModel, image_idx: int) -> ImageResiduals:
    """The inliers of the image in row ``image_idx``."""
    observations = model.observations
    linked = slice(*observations.offsets[image_idx : image_idx + 2])
    point_idx = observations.point_idx[linked]
    return image_residuals(model.image(image_idx), observations.xy_px[linked], _points_of(model, point_idx), point_idx)
