"""Does an estimated camera hold, and do the correspondences determine it? (method.md sections 2, 4, 5, 6, 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sfm_audit.audit.calibrate.estimate import DegenerateInputError, Estimate
from sfm_audit.audit.calibrate.evidence import (
    PlaneGeometry,
    expected_error_of,
    fronto_parallel_reason,
    identifiability_of,
    plane_geometry,
    plausibility_of,
)
from sfm_audit.audit.calibrate.lens_misfit import misfit_tests
from sfm_audit.audit.calibrate.lidar import lidar_noise, lidar_predictors
from sfm_audit.audit.camera_quality.coverage import coverage, occupied_cells
from sfm_audit.audit.camera_quality.expected_error import ExpectedErrorMap
from sfm_audit.audit.camera_quality.identifiability import Identifiability
from sfm_audit.audit.camera_quality.plausibility import CameraPlausibility
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide
from sfm_audit.audit.decision.decisions import Decision
from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    Diagnostics,
    MisfitDiagnostics,
    NoiseDiagnostics,
    misfit_groups,
)
from sfm_audit.audit.decision.judged import Judgement, undetermined
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.inliers.residuals import longest_px
from sfm_audit.audit.inliers.stationarity import pose_offset_px
from sfm_audit.audit.misfit import GROUPS, MisfitTests
from sfm_audit.audit.misfit.multiplicity import holm
from sfm_audit.audit.noise.standardise import ImageNoise, constant_noise
from sfm_audit.audit.normality import NormalityTests, normality_tests
from sfm_audit.audit.table.words import Member, Reason, ReasonCode, Verdict
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

NoiseChoice = Literal["auto", "constant", "lidar"]

DEFAULTS: Final = AuditConfig(noise="constant", points="independent", min_effect="0.5sigma")
"""Thresholds of a validation. Corner detectors are good to 0.03 px, where 0.2 px would let every wrong lens pass."""


@dataclass(frozen=True, slots=True, eq=False)
class StandardisedResiduals:
    """Residuals of the inliers under one scale.

    noise: z (n, 2) and its scale; rows of z are NaN where a neighbour in the scan has no image.
    sd_px: RMS of the predicted standard deviations, px.    tests: of the other rows of z.
    """

    noise: ImageNoise
    sd_px: float
    tests: NormalityTests


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """What is known of one estimate; everything is about its inliers.

    noise_name: constant or lidar.    xy_px, residuals_px: (n, 2) observed, and observed - projected.
    sd_px: empirical, per axis, sqrt(mean eps^2).    robust, plain: under the robust and under the plain scale.
    tests: of misfit.                 tau_px: effect that matters.    expected_error: conditional on the points.
    decision: as about an image of a reconstruction; q of its misfit is Holm's p.
    """

    estimate: Estimate
    noise_name: str
    xy_px: FloatArray
    residuals_px: FloatArray
    sd_px: float
    robust: StandardisedResiduals
    plain: StandardisedResiduals
    sigma_constant_px: float
    tests: MisfitTests
    tau_px: float
    pose_offset_px: float
    geometry: PlaneGeometry
    plausibility: CameraPlausibility
    identifiability: Identifiability
    coverage: float
    occupied_cells: int
    expected_error: ExpectedErrorMap
    decision: Decision

    @property
    def verdict(self) -> Verdict:
        """The verdict of the policy."""
        return self.decision.verdict

    @property
    def misfit(self) -> MisfitDecision:
        """The misfit that was found."""
        if self.decision.misfit is None:
            raise ValueError("a validation without tests of misfit")
        return self.decision.misfit

    @property
    def error_quartiles_px(self) -> tuple[float, float]:
        """First and third quartile of the reprojection distance |eps|."""
        first, third = np.quantile(np.hypot(*self.residuals_px.T), (0.25, 0.75))
        return float(first), float(third)

    @property
    def olsson_accepts(self) -> bool:
        """Baseline (method.md section 8): the mean distance lies between its first and third quartile."""
        first, third = self.error_quartiles_px
        return bool(first <= np.hypot(*self.residuals_px.T).mean() <= third)


def validate(
    estimate: Estimate,
    correspondences: Correspondences,
    *,
    noise: NoiseChoice = "auto",
    config: AuditConfig = DEFAULTS,
) -> Validation:
    """Ask of an estimate all that the auditor asks of an image of a reconstruction.

    Parameters
    ----------
    noise : ``lidar`` needs the points' neighbours in the scan; ``auto`` is lidar where there are any, else constant
    config : thresholds and policy; its ``noise`` and ``points`` are not used: the points are independent of the image

    Raises
    ------
    ValueError
        ``lidar`` without neighbours, or an estimate without inliers.

    Notes
    -----
    One image: q of the misfit groups is Holm's p. N of the score test is exactly what was estimated. Residuals of the
    estimate need not be at its least squares optimum; to first order the test does not see the difference.
    Standard deviations, expected error and the fields of the misfit test take the points as exact: noise of the lidar
    is in the residuals' variance, which the test leaves free.
    """
    kept = estimate.inliers
    if not kept.any():
        raise ValueError(f"{estimate.name}: an estimate without inliers")
    xy_px, xyz_cam = correspondences.xy_px[kept], estimate.xyz_cam(correspondences.xyz_world[kept])
    residuals_px = np.ascontiguousarray(estimate.residuals_px[kept].T)
    constant = constant_noise(residuals_px)
    noise_name = noise if noise != "auto" else "lidar" if correspondences.has_neighbours else "constant"
    robust, plain = _standardised(estimate, correspondences, constant, noise_name)
    projected = estimate.camera.project(xyz_cam)
    tau_px = config.tau_px(constant.sigma_constant_px)
    tests = misfit_tests(estimate, correspondences, robust.noise if noise_name == "lidar" else None)
    offset = pose_offset_px(residuals_px, projected.pose[3:].transpose(1, 0, 2), xyz_cam)
    camera = estimate.camera
    found = _Evidence(
        offset,
        plane_geometry(xyz_cam),
        plausibility_of(camera),
        identifiability_of(estimate),
        coverage(xy_px, camera.width, camera.height),
        occupied_cells(xy_px, camera.width, camera.height, config.grid),
    )
    misfit = _misfit(tests, len(xy_px), constant.sigma_constant_px)
    decision = decide(_diagnostics(estimate, residuals_px, robust, misfit, found), config)
    return Validation(
        estimate,
        noise_name,
        xy_px,
        residuals_px.T,
        math.sqrt(float((residuals_px**2).mean())),
        robust,
        plain,
        constant.sigma_constant_px,
        tests,
        tau_px,
        offset,
        found.geometry,
        found.plausibility,
        found.identifiability,
        found.coverage,
        found.occupied_cells,
        expected_error_of(estimate, correspondences, constant.sigma_constant_px),
        decision,
    )


def degenerate_judgement(error: DegenerateInputError) -> Judgement:
    """Judge correspondences that determine no camera: undetermined, with the reason."""
    detail = f"{error.degeneracy.value}, {error.detail}"
    return undetermined(Reason(ReasonCode.DEGENERATE_INPUT, Member.PLAUSIBLE, detail))


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """What `validate` and `_diagnostics` share."""

    pose_offset_px: float
    geometry: PlaneGeometry
    plausibility: CameraPlausibility
    identifiability: Identifiability
    coverage: float
    occupied_cells: int


def plain_constant_noise(residuals_px: FloatArray) -> ImageNoise:
    """One maximum-likelihood scale for the residuals (2, n), which large residuals inflate."""
    sigma = math.sqrt(float((residuals_px**2).mean()))
    with np.errstate(invalid="ignore", divide="ignore"):
        z = residuals_px.T / sigma
    return ImageNoise(z, sigma, sigma, math.nan, sigma, math.nan, converged=sigma > 0.0)


def _standardised(
    estimate: Estimate, correspondences: Correspondences, constant: ImageNoise, noise_name: str
) -> tuple[StandardisedResiduals, StandardisedResiduals]:
    """Residuals under the robust and under the plain scale of a noise model."""
    if noise_name == "constant":
        plain = plain_constant_noise(estimate.residuals_px[estimate.inliers].T)
        return (
            StandardisedResiduals(constant, constant.sigma_d_px, normality_tests(constant.z)),
            StandardisedResiduals(plain, plain.sigma_d_px, normality_tests(plain.z)),
        )
    a_sq = lidar_predictors(estimate, correspondences)[estimate.inliers] ** 2
    known = np.isfinite(a_sq).all(axis=1)  # a neighbour in the scan may have no image
    found = []
    for robust in (True, False):
        noise = lidar_noise(estimate, correspondences, robust=robust)
        variance = noise.sigma_d_px**2 + noise.sigma_l**2 * a_sq[known]
        sd_px = math.sqrt(float(variance.mean())) if known.any() else math.nan
        found.append(StandardisedResiduals(noise, sd_px, normality_tests(noise.z[known])))
    return found[0], found[1]


def _misfit(tests: MisfitTests, num_observations: int, sigma_px: float) -> MisfitDiagnostics:
    adjusted = holm(np.array([tests[group].p for group in GROUPS]))
    groups = misfit_groups(tests, adjusted, num_observations=num_observations, sigma_px=sigma_px)
    return MisfitDiagnostics(groups, num_observations, sigma_px)


def _diagnostics(
    estimate: Estimate,
    residuals_px: FloatArray,
    standardised: StandardisedResiduals,
    misfit: MisfitDiagnostics,
    found: _Evidence,
) -> Diagnostics:
    """What is decided upon, as of an image of a reconstruction."""
    known, camera, tests = found.identifiability, estimate.camera, standardised.tests
    warning = fronto_parallel_reason(found.geometry, estimate)
    return Diagnostics(
        num_inliers=residuals_px.shape[1],
        noise=NoiseDiagnostics(
            tests.num_values // 2, tests.num_values, tests.ks_stat, tests.ks_p, is_fitted=not math.isnan(tests.ks_p)
        ),
        pose_offset_px=found.pose_offset_px,
        misfit=misfit,
        camera=CameraDiagnostics(
            focal_over_size=found.plausibility.focal_over_size,
            folds_over=found.plausibility.folds_over,
            principal_point_px=found.plausibility.principal_point_px,
            size_px=found.plausibility.size_px,
            coverage=found.coverage,
            occupied_cells=found.occupied_cells,
            has_focal=known.has_focal,
            sd_focal_rel=known.sd_focal_rel,
            singular_share=known.parameters.singular_share,
            is_singular=known.parameters.is_singular,
            k1=known.k1 if known.has_k1 else None,
            sd_k1=known.sd_k1,
        ),
        largest_residual_px=longest_px(residuals_px),
        longer_side_px=max(camera.width, camera.height),
        remarks=() if warning is None else (warning,),
    )
