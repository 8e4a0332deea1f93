"""What do the inliers of an estimate say about its camera? (method.md section 6, for cameras of audit/calibrate)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.audit.camera_quality.expected_error import ExpectedErrorMap, measurement_error_px
from sfm_audit.audit.camera_quality.identifiability import POSE_NAMES, Identifiability
from sfm_audit.audit.camera_quality.plausibility import CameraPlausibility, folds_over
from sfm_audit.audit.camera_quality.shapes import GRID, cell_centres_px
from sfm_audit.audit.table.words import Member, Reason, ReasonCode
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

_FLAT: Final = 1e-2  # planarity: a metre of points is within a centimetre of a plane
_FRONTO_PARALLEL_DEG: Final = 5.0
_NUM_RADII: Final = 256
_FOCALS: Final = ("f", "fx", "fy")


@dataclass(frozen=True, slots=True)
class PlaneGeometry:
    """How flat the 3D points lie, and how that plane lies to the image; a plane parallel to it does not show f.

    planarity: smallest / largest singular value of the centred points; 0 on a plane, NaN without extent.
    tilt_deg: angle of the plane that fits best with the image plane, 0..90, deg.
    """

    planarity: float
    tilt_deg: float

    @property
    def is_fronto_parallel(self) -> bool:
        """Whether focal length and distance act almost alike on these points."""
        return self.planarity < _FLAT and self.tilt_deg < _FRONTO_PARALLEL_DEG


def plane_geometry(xyz_cam: FloatArray) -> PlaneGeometry:
    """Measure points (n, 3) in the camera frame; NaN with fewer than three."""
    if len(xyz_cam) < 3:
        return PlaneGeometry(math.nan, math.nan)
    _, singular, rows = np.linalg.svd(xyz_cam - xyz_cam.mean(axis=0), full_matrices=False)
    if singular[0] == 0.0:
        return PlaneGeometry(math.nan, math.nan)
    across, along = float(np.hypot(*rows[2, :2])), abs(float(rows[2, 2]))
    return PlaneGeometry(float(singular[2] / singular[0]), math.degrees(math.atan2(across, along)))


def fronto_parallel_reason(geometry: PlaneGeometry, estimate: Estimate) -> Reason | None:
    """Warn of points in a plane that is nearly parallel to the image: f and distance are hard to tell apart."""
    if not geometry.is_fronto_parallel:
        return None
    correlation = correlation_focal_depth(estimate)
    detail = f"tilt {geometry.tilt_deg:.2g} deg, correlation of focal length and distance {correlation:.6f}"
    return Reason(ReasonCode.FRONTO_PARALLEL, Member.PLAUSIBLE, detail, geometry.tilt_deg, _FRONTO_PARALLEL_DEG, "deg")


def identifiability_of(estimate: Estimate) -> Identifiability:
    """Summarise the covariance of an estimate; see `audit.camera_quality.identifiability.identifiability`."""
    camera, parameters = estimate.camera, estimate.covariance
    values = {"f": camera.focal_px[0], "fx": camera.focal_px[0], "fy": camera.focal_px[1]}
    focals = [(parameters.sd_of(name), values[name]) for name in _FOCALS if name in camera.estimated]
    has_k1 = "k1" in camera.estimated
    return Identifiability(
        parameters,
        focals[0][0] if focals else math.nan,
        max((sd / abs(focal) for sd, focal in focals), default=math.nan),
        parameters.sd_of("k1") if has_k1 else math.nan,
        float(camera.coefficients[0]),
        has_focal=bool(focals),
        has_k1=has_k1,
    )


def correlation_focal_depth(estimate: Estimate) -> float:
    """Correlation of the (first) focal length with the distance along the axis; NaN where either is unknown."""
    names = estimate.covariance.names
    focal = next((name for name in _FOCALS if name in names), None)
    if focal is None or "translation_z" not in names:
        return math.nan
    return float(estimate.covariance.correlation[names.index(focal), names.index("translation_z")])


def plausibility_of(camera: CalibratedCamera) -> CameraPlausibility:
    """Measure the camera alone."""
    size = camera.width, camera.height
    return CameraPlausibility(camera.focal_px[0] / max(size), camera_folds(camera), camera.principal_point_px, size)


def camera_folds(camera: CalibratedCamera) -> bool:
    """Whether the distortion folds inside the image; see `audit.camera_quality.plausibility.folds_over`.

    A division model folds where no ray reaches a pixel between the principal point and the farthest corner.
    """
    if camera.distortion is Distortion.FORWARD and camera.colmap is not None:
        return folds_over(camera.colmap)
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    centre = np.array(camera.principal_point_px)
    farthest = corners[np.argmax((((corners - centre) / camera.focal_px) ** 2).sum(axis=1))]
    share = np.arange(1, _NUM_RADII + 1)[:, None] / _NUM_RADII
    return bool(np.isnan(camera.undistort(centre + share * (farthest - centre))).any())


def expected_error_of(estimate: Estimate, correspondences: Correspondences, sigma_px: float) -> ExpectedErrorMap:
    """Return the expected error of one measurement at every cell centre of the image.

    Parameters
    ----------
    sigma_px : noise of a measurement per axis, px

    Notes
    -----
    method.md section 6 as `expected_error_map` has it, on each pixel's ray at the median distance
    of the inliers; NaN where no ray reaches the pixel, everywhere where the covariance is unknown.
    """
    camera = estimate.camera
    pixels = cell_centres_px(camera.width, camera.height)
    depth = float(np.median(estimate.xyz_cam(correspondences.xyz_world[estimate.inliers])[:, 2]))
    u = camera.undistort(pixels.reshape(-1, 2))
    projected = camera.project(depth * np.column_stack([u, np.ones(len(u))]))
    columns = np.concatenate([projected.pose, projected.d_params])
    with np.errstate(invalid="ignore", over="ignore"):
        error = measurement_error_px(columns, (*POSE_NAMES, *camera.estimated), estimate.covariance, sigma_px)
    return ExpectedErrorMap(pixels, error.reshape(GRID, GRID))
