"""What a camera predicts for the points of an image, with derivatives (what method.md section 5's N and E are made of).

The walk over a model projects every observation once (`audit.inliers.residuals`); `image_inliers` puts that together
again for one image, from what was kept: residuals, derivatives in the point and in the distortion parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from sfm_audit.audit.cameras import normalised, project_columns
from sfm_audit.audit.inliers.residuals import ImageResiduals, ModelResiduals
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord, ImageRecord, InlierSet, SparseModel, rotation_from_quat


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedImage:
    """What a camera predicts for the n points of an image; no observed point ever enters.

    Columns of Jacobians come first, then x and y, then points: (c, 2, n), contiguous.

    xy_px: (2, n) predicted, distorted px.
    u: (2, n) undistorted normalised point, fisheye models theta (X, Y) / rho; NaN for spherical models.
    pose: (6, 2, n) px per rad and px per model unit, left perturbation in the camera frame.
    d_params: (p, 2, n) px per unit of each parameter, in COLMAP's order; `image_inliers` has none of spherical models.
    """

    xy_px: FloatArray
    u: FloatArray
    pose: FloatArray
    d_params: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ImageInliers:
    """The inliers of one image and what its camera predicts for them; rows and columns are the same observations.

    xy_px: (n, 2) observed, distorted.    xyz_world: (n, 3).    residuals_px: (2, n) observed - projected.
    xyz_cam: (n, 3), each coordinate contiguous.    jacobian_cam: (2, 3, n) d projection / d point, camera frame.
    d_extra: (e, 2, n) px per unit of each distortion parameter.
    """

    image: ImageRecord
    camera: CameraRecord
    xy_px: FloatArray
    xyz_world: FloatArray
    residuals_px: FloatArray
    xyz_cam: FloatArray
    jacobian_cam: FloatArray
    d_extra: FloatArray

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def predicted_px(self) -> FloatArray:
        """(2, n) px, without projecting again: observed - residual."""
        return np.subtract(self.xy_px.T, self.residuals_px, order="C")

    @property
    def u(self) -> FloatArray:
        """(2, n) as of `ProjectedImage`."""
        return np.ascontiguousarray(normalised(self.camera.model, self.camera.params, self.xyz_cam).T)

    @property
    def projected(self) -> ProjectedImage:
        """What the camera predicts, without projecting again."""
        xy_px, pose = self.predicted_px, pose_columns(self.jacobian_cam, self.xyz_cam)
        return ProjectedImage(xy_px, self.u, pose, _d_params(self.camera, xy_px, self.d_extra))


def cams_from_gradients(quat_cam_from_world_wxyz: FloatArray) -> FloatArray:
    """Return (B, 3, 3) from derivatives in a point in the world to those in the camera's frame, of (B, 4) poses.

    d / d world = d / d cam R; R of a quaternion that is no unit has no transpose for an inverse.
    """
    return np.asarray(np.linalg.pinv(rotation_from_quat(quat_cam_from_world_wxyz).swapaxes(-1, -2)))


def image_inliers(
    model: SparseModel,
    residuals: ModelResiduals,
    image_idx: int,
    chosen: IntArray | None = None,
    cam_from_gradient: FloatArray | None = None,
) -> ImageInliers:
    """Return the inliers of the image in row ``image_idx`` of a model.

    Parameters
    ----------
    chosen : which of the image's inliers; all when None
    cam_from_gradient : (3, 3) that of the image out of `cams_from_gradients`, where several were made at once

    Raises
    ------
    ValueError
        when the image has no camera, and so no inliers.
    """
    image, rows = model.image(image_idx), residuals.rows(image_idx)
    if image.camera is None:
        raise ValueError(f"image {image.image_id} has no camera")
    columns: IntArray | slice = rows if chosen is None else rows.start + chosen
    xyz_world = model.points.xyz_world.take(residuals.point_idx[columns], axis=0)
    turn = np.linalg.pinv(image.rotation_cam_from_world.T) if cam_from_gradient is None else cam_from_gradient
    d_extra = residuals.d_extra[image_idx]
    return ImageInliers(
        image,
        image.camera,
        model.observations.xy_px.take(residuals.observation_row[columns], axis=0),
        xyz_world,
        residuals.residuals_px[:, columns],
        np.asfortranarray(image.cam_from_world(xyz_world)),
        turn @ residuals.point_jacobian[:, :, columns],
        d_extra if chosen is None else d_extra.take(chosen, axis=2),
    )


def inlier_set(model: SparseModel, residuals: ModelResiduals, image_idx: int) -> InlierSet:
    """Return the inliers of the image in row ``image_idx`` as its users see them."""
    observations = model.observations
    row = residuals.observation_row[residuals.rows(image_idx)]
    point_idx = observations.point_idx[row]
    return InlierSet(
        model.image(image_idx),
        observations.xy_px.take(row, axis=0),
        model.points.xyz_world.take(point_idx, axis=0),
        point_idx.astype(np.int64),
        num_dangling=int(residuals.num_dangling[image_idx]),
        num_behind=int(residuals.num_behind[image_idx]),
        num_nonfinite=int(residuals.num_nonfinite[image_idx]),
    )


def inliers_of(image: ImageRecord, xy_px: FloatArray, xyz_world: FloatArray, part: ImageResiduals) -> ImageInliers:
    """Return the inliers of an image without a model, from its observations (m, 2), (m, 3) and `image_residuals`."""
    if image.camera is None:
        raise ValueError(f"image {image.image_id} has no camera")
    rows = part.inlier_row
    return ImageInliers(
        image,
        image.camera,
        xy_px[rows],
        xyz_world[rows],
        part.residuals_px,
        part.xyz_cam,
        part.jacobian_cam,
        part.d_extra,
    )


def project_image(camera: CameraRecord, xyz_cam: FloatArray) -> ProjectedImage:
    """Project the points (n, 3), in the camera frame, of one image; values are NaN where a point does not project."""
    xyz_cam = np.asfortranarray(xyz_cam)  # each coordinate contiguous
    projection = project_columns(camera.model, camera.params, xyz_cam)
    return ProjectedImage(
        projection.xy_px,
        np.ascontiguousarray(normalised(camera.model, camera.params, xyz_cam).T),
        pose_columns(projection.d_xy_d_cam, xyz_cam),
        cast("FloatArray", projection.d_xy_d_params),
    )


def _d_params(camera: CameraRecord, xy_px: FloatArray, d_extra: FloatArray) -> FloatArray:
    """(p, 2, n): x = f v + c, with v the distorted normalised point, so that d x / d f = (x - c) / f."""
    model, params = camera.model, camera.params
    if model.is_spherical:
        return np.empty((0, 2, xy_px.shape[1]))
    out = np.zeros((model.num_params, *xy_px.shape))
    focals, centre = model.focal_idxs, model.principal_point_idxs
    for axis, focal in enumerate((focals[0], focals[-1])):
        out[focal, axis] = (xy_px[axis] - params[centre[axis]]) / params[focal]
        out[centre[axis], axis] = 1.0
    out[list(model.extra_idxs)] = d_extra
    return out
