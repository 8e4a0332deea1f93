"""What the image's own fit could have absorbed: projections and their Jacobians (method.md section 5's N)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from sfm_audit.audit.cameras import normalised, project_columns
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedImage:
    """What a camera predicts for the n points of an image; no observed point ever enters.

    Columns of Jacobians come first, then x and y, then points: (c, 2, n), contiguous.

    xy_px: (2, n) predicted, distorted px.
    u: (2, n) undistorted normalised point, fisheye models theta (X, Y) / rho; NaN for spherical models.
    pose: (6, 2, n) px per rad and px per model unit, left perturbation in the camera frame.
    d_params: (p, 2, n) px per unit of each parameter, in COLMAP's order.
    """

    xy_px: FloatArray
    u: FloatArray
    pose: FloatArray
    d_params: FloatArray


def project_image(camera: CameraRecord, xyz_cam: FloatArray) -> ProjectedImage:
    """Project the points (n, 3), in the camera frame, of one image; values are NaN where a point does not project."""
    xyz_cam = np.asfortranarray(xyz_cam)  # each coordinate contiguous
    projection = project_columns(camera.model, camera.params, xyz_cam)
    return ProjectedImage(
        projection.xy_px,
        np.ascontiguousarray(normalised(camera.model, camera.params, xyz_cam).T),
        pose_columns(projection.d_xy_d_cam, xyz_cam.T),
        cast("FloatArray", projection.d_xy_d_params),
    )


def fitted_param_idxs(model: CameraModel) -> tuple[int, ...]:
    """Return the parameters that COLMAP refines by default: all but the principal point (spherical models: none)."""
    if model.is_spherical:
        return ()
    return tuple(i for i in range(model.num_params) if i not in model.principal_point_idxs)


def nuisance_columns(
    model: CameraModel, projected: ProjectedImage, param_idxs: tuple[int, ...] | None = None
) -> FloatArray:
    """Return N, (6 + k, 2, n): the Jacobian in what was fitted to this image, 6 columns of the pose first.

    Parameters
    ----------
    param_idxs : the k parameters that were fitted; `fitted_param_idxs` by default. An estimator that fitted others
        must say so: a parameter fitted but left out makes the test liberal, one put in but never fitted hides misfit.

    Notes
    -----
    Columns that are zero (skewless models have none, a parameter without effect has) stay in; the test drops them.
    """
    chosen = fitted_param_idxs(model) if param_idxs is None else param_idxs
    return np.concatenate([projected.pose, projected.d_params[list(chosen)]])
