"""Which observations are inliers, and what is left of each after projection (METHOD.md section 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from audit.cameras import project_with_jacobians
from audit.stationarity import pose_offset_px
from loaders.arrays import BoolArray, FloatArray, IntArray
from loaders.model import ImageRecord, InlierSet, SparseModel


@dataclass(frozen=True, slots=True, eq=False)
class ImageResiduals:
    """The inliers of one image, projected.

    inliers: the 2D-3D inliers.                   inlier_row: (n,) their rows among the observations given.
    residuals_px: (2, n) observed - projected.    point_jacobian: (2, 3, n) d projection / d point in the world, px
    per model unit.                               pose_offset_px: METHOD.md section 6, NaN without inliers.
    """

    inliers: InlierSet
    inlier_row: IntArray
    residuals_px: FloatArray
    point_jacobian: FloatArray
    pose_offset_px: float


@dataclass(frozen=True, slots=True, eq=False)
class ModelResiduals:
    """The inliers of all images of a model, by image in ImageTable order, then by POINTS2D order.

    offsets: (I + 1,) image i owns columns offsets[i]:offsets[i + 1].    observation_row: (n,) rows of ObservationTable.
    point_idx: (n,) rows of PointTable.                                  residuals_px: (2, n) observed - projected.
    point_jacobian: (2, 3, n) px per model unit, world frame.            pose_offset_px: (I,) NaN without inliers.
    num_dangling, num_behind, num_nonfinite: (I,) linked observations that are no inliers, by cause.
    """

    offsets: IntArray
    observation_row: IntArray
    point_idx: IntArray
    residuals_px: FloatArray
    point_jacobian: FloatArray
    pose_offset_px: FloatArray
    num_dangling: IntArray
    num_behind: IntArray
    num_nonfinite: IntArray

    def rows(self, image_idx: int) -> slice:
        """Columns of the image in row ``image_idx`` of the image table."""
        return slice(int(self.offsets[image_idx]), int(self.offsets[image_idx + 1]))


def image_residuals(
    image: ImageRecord, xy_px: FloatArray, xyz_world: FloatArray, point_idx: IntArray
) -> ImageResiduals:
    """Project the linked points of one image and keep those that can be audited.

    Parameters
    ----------
    image : pose and camera; without a camera nothing is projected and all count as not finite
    xy_px : (m, 2) observed, distorted px        xyz_world : (m, 3), rows of dangling points are ignored
    point_idx : (m,) rows of the point table, -1 = dangling

    Notes
    -----
    METHOD.md section 1: an observation enters if its point exists, Zc > 0 (spherical cameras: Xc != 0) and its
    projection is finite. Observations that are themselves not finite count as not finite.
    """
    linked = point_idx >= 0
    num_dangling = int(linked.size - np.count_nonzero(linked))
    camera = image.camera
    with np.errstate(all="ignore"):
        xyz_cam = image.cam_from_world(xyz_world)
        finite = np.isfinite(xyz_cam).all(axis=1) & np.isfinite(xy_px).all(axis=1)
        spherical = camera is not None and camera.model.is_spherical
        in_front = (xyz_cam != 0).any(axis=1) if spherical else xyz_cam[:, 2] > 0
        candidate = np.flatnonzero(linked & finite & in_front)
        num_behind = int(np.count_nonzero(linked & finite & ~in_front))
        if camera is None or not np.isfinite(camera.params).all():
            candidate, num_behind = candidate[:0], 0
            xy_projected, jacobian_cam = np.empty((0, 2)), np.empty((0, 2, 3))
        else:
            projection = project_with_jacobians(camera.model, camera.params, xyz_cam[candidate], with_params=False)
            xy_projected, jacobian_cam = projection.xy_px, projection.d_xy_d_cam
        valid = np.isfinite(xy_projected).all(axis=1)
    if not valid.all():
        candidate, xy_projected, jacobian_cam = candidate[valid], xy_projected[valid], jacobian_cam[valid]
    rows = candidate
    residuals = xy_px[rows] - xy_projected
    if camera is not None and camera.model.is_spherical:
        residuals[:, 0] -= camera.width * np.round(residuals[:, 0] / camera.width)  # the seam is no edge
    jacobian_world = jacobian_cam.reshape(-1, 3) @ image.rotation_cam_from_world
    inliers = InlierSet(
        image,
        xy_px[rows],
        xyz_world[rows],
        point_idx[rows],
        num_dangling=num_dangling,
        num_behind=num_behind,
        num_nonfinite=int(linked.size) - num_dangling - num_behind - len(rows),
    )
    return ImageResiduals(
        inliers,
        rows,
        residuals.T.copy(),
        np.ascontiguousarray(jacobian_world.reshape(-1, 2, 3).transpose(1, 2, 0)),
        pose_offset_px(residuals, jacobian_cam, xyz_cam[rows]),
    )


def _points_of(model: SparseModel, point_idx: IntArray) -> FloatArray:
    """(m, 3) world points; NaN where dangling."""
    if not len(model.points):
        return np.full((len(point_idx), 3), np.nan)
    xyz = model.points.xyz_world[point_idx]
    dangling: BoolArray = point_idx < 0
    if dangling.any():
        xyz[dangling] = np.nan
    return xyz


def inliers_of(model: SparseModel, image_idx: int) -> ImageResiduals:
    """Return the inliers of the image in row ``image_idx`` with their residuals."""
    first, last = model.observations.offsets[image_idx : image_idx + 2]
    point_idx = model.observations.point_idx[first:last]
    return image_residuals(
        model.image(image_idx), model.observations.xy_px[first:last], _points_of(model, point_idx), point_idx
    )


def model_residuals(model: SparseModel) -> ModelResiduals:
    """Return the inliers of all images with their residuals; one pass over the images, arrays throughout."""
    num_images, capacity = len(model.images), len(model.observations)
    offsets = np.zeros(num_images + 1, dtype=np.int64)
    observation_row = np.empty(capacity, dtype=np.int64)
    residuals = np.empty((2, capacity))
    jacobian = np.empty((2, 3, capacity))
    pose_offset = np.full(num_images, np.nan)
    counts = np.zeros((3, num_images), dtype=np.int64)
    for image_idx in range(num_images):
        part = inliers_of(model, image_idx)
        first = offsets[image_idx]
        last = offsets[image_idx + 1] = first + part.inlier_row.size
        observation_row[first:last] = part.inlier_row + model.observations.offsets[image_idx]
        residuals[:, first:last] = part.residuals_px
        jacobian[:, :, first:last] = part.point_jacobian
        pose_offset[image_idx] = part.pose_offset_px
        counts[:, image_idx] = part.inliers.num_dangling, part.inliers.num_behind, part.inliers.num_nonfinite
    total = offsets[-1]
    observation_row = observation_row[:total]
    return ModelResiduals(
        offsets,
        observation_row,
        model.observations.point_idx[observation_row],
        residuals[:, :total],
        jacobian[:, :, :total],
        pose_offset,
        *counts,
    )
