"""Which correspondences determine no camera at all, and which fitted cameras are none."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError, Estimate
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

FLAT: Final = 1e-7
"""Extent of points across a line, as a share of that along, at or below which they are on it."""
ROUNDING: Final = 1e-12
"""Extent of points, as a share of their coordinates, at or below which they are one spot but for rounding."""
LARGEST: Final = 1e100
"""Coordinates from which on squares overflow."""
SMALLEST_SHARE: Final = 0.5
"""Share of the correspondences that must agree with a camera; chance reaches less (measured, see the tests)."""


def check_points(correspondences: Correspondences, num_parameters: int, threshold_px: float) -> None:
    """Refuse correspondences that determine no camera, whatever their noise.

    Raises
    ------
    DegenerateInputError
        coordinates that are not finite (or beyond 1e100), fewer different points than parameters, points on one spot
        or on one line of the world or of the image. One spot of the image is as large as the inlier threshold: within
        it every camera would do.
    """
    xy_px, xyz_world = correspondences.xy_px, correspondences.xyz_world
    usable = (np.abs(xy_px) < LARGEST).all(axis=1) & (np.abs(xyz_world) < LARGEST).all(axis=1)
    num_bad = int(np.count_nonzero(~usable))
    if num_bad:
        raise DegenerateInputError(Degeneracy.NOT_FINITE, f"{num_bad} of {len(xy_px)} correspondences")
    num_points = len(np.unique(xyz_world, axis=0)) if len(xyz_world) else 0
    if num_points < num_parameters:
        detail = f"{num_points} different points for {num_parameters} parameters"
        raise DegenerateInputError(Degeneracy.TOO_FEW_POINTS, detail)
    rounding = ROUNDING * float(np.abs(xyz_world).max())
    for points, where, spot in ((xyz_world, "in the world", rounding), (xy_px, "in the image", threshold_px)):
        extents = extents_of(points)
        if extents[0] <= spot:
            raise DegenerateInputError(Degeneracy.ONE_SPOT, f"{where}, RMS extent {extents[0]:.3g}")
        if extents[1] <= FLAT * extents[0]:
            share = extents[1] / extents[0]
            raise DegenerateInputError(Degeneracy.COLLINEAR, f"{where}, extent across the line {share:.3g} of along")


def extents_of(points: FloatArray) -> FloatArray:
    """RMS extents of points (n, d) about their centroid along their principal axes, largest first, (d,)."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return np.asarray(singular / np.sqrt(len(points)))


def check_consensus(inliers: BoolArray, num_parameters: int) -> None:
    """Refuse a camera that too few correspondences agree with: such a one is found in noise, too."""
    num_inliers, needed = int(np.count_nonzero(inliers)), max(num_parameters, SMALLEST_SHARE * len(inliers))
    if num_inliers < needed:
        raise DegenerateInputError(Degeneracy.NO_CONSENSUS, f"{num_inliers} of {len(inliers)} correspondences agree")


def check_camera(estimate: Estimate, xyz_world: FloatArray) -> Estimate:
    """Return the estimate, unless it is no camera or its focal length is not determined at all.

    Raises
    ------
    DegenerateInputError
        NOT_A_CAMERA: an inlier is behind the camera or beyond the fold of the distortion, or the focal length is not
        positive. FRONTO_PARALLEL: some combination of the parameters leaves all predictions where they are; a plane
        parallel to the image is how that happens to points with extent.
    """
    camera, xyz_cam = estimate.camera, estimate.xyz_cam(xyz_world)[estimate.inliers]
    if not min(camera.focal_px) > 0.0:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, f"focal length {min(camera.focal_px):.3g} px")
    num_behind = int(np.count_nonzero(~(xyz_cam[:, 2] > 0.0)))
    if num_behind:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, f"{num_behind} inliers behind the camera")
    num_folded = int(np.count_nonzero(~before_fold(camera, xyz_cam)))
    if num_folded:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, f"{num_folded} inliers beyond the fold of the distortion")
    if estimate.covariance.is_singular:
        detail = f"smallest / largest singular value {estimate.covariance.singular_share:.1e}"
        raise DegenerateInputError(Degeneracy.FRONTO_PARALLEL, detail)
    return estimate


def before_fold(camera: CalibratedCamera, xyz_cam: FloatArray) -> BoolArray:
    """Whether the distorted radius still rises with the undistorted one, at points (n, 3) before the camera."""
    if camera.distortion is Distortion.DIVISION:
        return np.asarray(np.isfinite(camera.project(xyz_cam).xy_px).all(axis=0))
    r = np.hypot(xyz_cam[:, 0], xyz_cam[:, 1]) / xyz_cam[:, 2]
    return np.asarray(r < camera.fold_radius)
