"""What an extended PnP estimator returns, and what it says when the data do not determine a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera
from sfm_audit.audit.camera_quality.identifiability import POSE_NAMES, ParameterCovariance, parameter_covariance
from sfm_audit.audit.misfit import ProjectedImage
from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences


class Degeneracy(StrEnum):
    """Why no camera can be estimated. A closed list."""

    TOO_FEW_POINTS = "too_few_points"
    NOT_FINITE = "not_finite"
    ONE_SPOT = "one_spot"
    COLLINEAR = "collinear"
    FRONTO_PARALLEL = "fronto_parallel"
    NO_CONSENSUS = "no_consensus"
    NOT_A_CAMERA = "not_a_camera"


class DegenerateInputError(Exception):
    """The correspondences do not determine a camera; ``detail`` has the number that says so."""

    def __init__(self, degeneracy: Degeneracy, detail: str) -> None:
        super().__init__(f"{degeneracy.value}: {detail}")
        self.degeneracy = degeneracy
        self.detail = detail


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A camera that an estimator found, and the correspondences it stands on.

    name: of the estimator and its model ("D1", "D3", "pnprf", "colmap").          camera: see `CalibratedCamera`.
    rotation_cam_from_world: (3, 3).          translation_cam_from_world: (3,) model units.
    inliers: (n,) which correspondences the estimator kept.          residuals_px: (n, 2) observed - projected, of all.
    covariance: of the pose (`identifiability.POSE_NAMES`) and ``camera.estimated``, points taken as exact.
    """

    name: str
    camera: CalibratedCamera
    rotation_cam_from_world: FloatArray
    translation_cam_from_world: FloatArray
    inliers: BoolArray
    residuals_px: FloatArray
    covariance: ParameterCovariance

    def xyz_cam(self, xyz_world: FloatArray) -> FloatArray:
        """Return points (n, 3) in the camera frame."""
        return np.asarray(xyz_world @ self.rotation_cam_from_world.T + self.translation_cam_from_world)

    def project(self, xyz_world: FloatArray) -> ProjectedImage:
        """Project points (n, 3) of the world."""
        return self.camera.project(self.xyz_cam(xyz_world))


class Estimator(Protocol):
    """From correspondences to a camera. ``rng`` draws the samples of RANSAC; the same seed gives the same estimate."""

    def __call__(self, correspondences: Correspondences, rng: np.random.Generator) -> Estimate:
        """Estimate; raises `DegenerateInputError` where the data do not determine a camera."""
        ...


def estimate_of(
    name: str,
    camera: CalibratedCamera,
    rotation_cam_from_world: FloatArray,
    translation_cam_from_world: FloatArray,
    correspondences: Correspondences,
    *,
    inliers: BoolArray,
) -> Estimate:
    """Complete an estimate: residuals of all correspondences, covariance from the inliers' robust scale.

    The scale is that of the noise: the residuals' times 2 n / (2 n - q), for the q fitted parameters.
    """
    xyz_cam = correspondences.xyz_world @ rotation_cam_from_world.T + translation_cam_from_world
    projected = camera.project(xyz_cam)
    residuals = correspondences.xy_px - projected.xy_px.T
    columns = np.concatenate([projected.pose, projected.d_params])[:, :, inliers]
    num_free = columns[0].size - len(columns)
    variance_px2 = fit_constant_variance(residuals[inliers] ** 2).detector_px2
    sigma_px = math.sqrt(variance_px2 * columns[0].size / num_free) if num_free > 0 else math.nan
    covariance = parameter_covariance(columns, (*POSE_NAMES, *camera.estimated), sigma_px)
    return Estimate(name, camera, rotation_cam_from_world, translation_cam_from_world, inliers, residuals, covariance)
