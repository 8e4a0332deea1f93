"""One image, all questions: noise, tests of normality, diagnostics, decision."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from sfm_audit.audit.camera_quality.measure import CameraQuality, CameraShape, camera_quality
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide_all
from sfm_audit.audit.decision.decisions import Decision
from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Diagnostics,
    Gains,
    MisfitDiagnostics,
    NoiseDiagnostics,
    OwnDiagnostics,
    misfit_groups,
)
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.engine.camera import images_advice
from sfm_audit.audit.inliers.projected import inliers_of
from sfm_audit.audit.inliers.residuals import image_residuals, longest_px
from sfm_audit.audit.inliers.sanity import is_sane, is_usable
from sfm_audit.audit.misfit import MisfitTests, Retest, image_retest
from sfm_audit.audit.misfit.significance import Significance
from sfm_audit.audit.noise.standardise import ImageNoise, constant_noise
from sfm_audit.audit.normality import NormalityTests, normality_tests
from sfm_audit.audit.table.witnesses import WitnessStatement
from sfm_audit.audit.table.words import Member, Reason, ReasonCode, Verdict
from sfm_audit.loaders.arrays import FloatArray, Int32Array
from sfm_audit.loaders.model import CameraRecord, ImageRecord, InlierSet


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvidence:
    """What is known of one image before anything is decided.

    residuals_px: (2, n) observed - projected, of the inliers.        pose_offset_px: method.md 6.
    constant, chosen: the noise under one scale for all raw residuals, and under the noise model of the run.
    track_length: (n,) audited observations of each inlier's track; None where the points are independent of the image.
    quality, misfit: of the camera, and the tests on which the verdict rests; both None without inliers.
    retest: tries another camera model on the residuals of those tests.
    camera: the numbers of the camera that decide; those of ``quality`` where None.
    consistency, own, has_own, gains, half_pixel: see `Diagnostics`.
    expected_error_px: with the joint covariance, NaN unknown.
    implied: changes that parameters which nobody freed would take, by column.
    pose: how well the pose is known, by column; empty where nobody asked.
    testimonies, outside: what witnesses outside of the image say of it, and what they measured, by column.
    """

    inliers: InlierSet
    residuals_px: FloatArray
    pose_offset_px: float
    constant: ImageNoise
    chosen: ImageNoise
    track_length: Int32Array | None = None
    quality: CameraQuality | None = None
    misfit: MisfitDiagnostics | None = None
    retest: Retest | None = None
    camera: CameraDiagnostics | None = None
    consistency: ConsistencyDiagnostics | None = None
    own: OwnDiagnostics | None = None
    has_own: bool = False
    gains: Gains | None = None
    half_pixel: bool = False
    expected_error_px: float = math.nan
    implied: Mapping[str, float] = field(default_factory=dict)
    pose: Mapping[str, object] = field(default_factory=dict)
    testimonies: tuple[WitnessStatement, ...] | None = None
    outside: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ImageAudit:
    """What the audit says about one image.

    inliers: the 2D-3D inliers.          residuals_px: (n, 2) observed - projected.
    noise, tests: under the chosen noise model.          constant, constant_tests: one scale for all raw residuals.
    quality: of the camera, as the model stands; None without inliers.
    diagnostics, decision: the numbers that decide, and what was decided.
    expected_error_px, implied, outside, pose: see `ImageEvidence`.
    advised_camera_model: see `audit.misfit.advised_camera_model`.
    """

    inliers: InlierSet
    residuals_px: FloatArray
    track_length: Int32Array | None
    noise: ImageNoise
    tests: NormalityTests
    constant: ImageNoise
    constant_tests: NormalityTests
    quality: CameraQuality | None
    diagnostics: Diagnostics
    decision: Decision
    advised_camera_model: str | None
    expected_error_px: float = math.nan
    implied: Mapping[str, float] = field(default_factory=dict)
    outside: Mapping[str, object] = field(default_factory=dict)
    pose: Mapping[str, object] = field(default_factory=dict)

    def __repr__(self) -> str:
        codes = ", ".join(dict.fromkeys(reason.code for reason in self.reasons))
        why = f" ({codes})" if codes else ""
        return f"<ImageAudit of {self.image.name!r}: {self.verdict}{why}, {len(self.residuals_px)} inliers>"

    @property
    def image(self) -> ImageRecord:
        """The image that was audited."""
        return self.inliers.image

    @property
    def verdict(self) -> Verdict:
        """The verdict of the policy."""
        return self.decision.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The reasons of the policy's members."""
        return self.decision.reasons

    @property
    def misfit(self) -> MisfitDecision | None:
        """The misfit that was found; None where nothing was tested."""
        return self.decision.misfit

    @property
    def pose_offset_px(self) -> float:
        """RMS residual that moving the pose alone would remove, NaN without inliers."""
        return self.diagnostics.pose_offset_px


def audit_inliers(inliers: InlierSet, config: AuditConfig | None = None) -> ImageAudit:
    """Audit one image on its own, its 3D points taken as independent of it: noise model ``constant``.

    Parameters
    ----------
    inliers : observed points and the 3D points they belong to; observations that turn out to be behind the camera or
        without a finite projection are counted and left out, as method.md section 1 says
    config : thresholds; the defaults when None. Its ``noise`` is not used: other noise models need the tracks of the
        whole model (`sfm_audit.ModelAuditor`)

    Notes
    -----
    With points that were triangulated from this very image the residuals are shrunk (method.md section 3a).
    """
    config = config or AuditConfig()
    part = image_residuals(inliers.image, inliers.xy_px, inliers.xyz_world, inliers.point_idx)
    rows = part.inlier_row
    kept = InlierSet(
        inliers.image,
        inliers.xy_px[rows],
        inliers.xyz_world[rows],
        inliers.point_idx[rows],
        num_dangling=inliers.num_dangling + part.num_dangling,
        num_behind=inliers.num_behind + part.num_behind,
        num_nonfinite=inliers.num_nonfinite + part.num_nonfinite,
    )
    constant = constant_noise(part.residuals_px)
    sigma_px = constant.sigma_constant_px
    camera = inliers.image.camera
    shape = None if camera is None else CameraShape.of(camera)
    quality, misfit = None, None
    if shape is not None:
        own = inliers_of(inliers.image, inliers.xy_px, inliers.xyz_world, part)
        quality = camera_quality(shape, own, sigma_px, grid=config.grid)
    if quality is not None:
        q = Significance.of([quality.misfit]).q[0]
        groups = misfit_groups(quality.misfit, q, num_observations=len(rows), sigma_px=sigma_px)
        misfit = MisfitDiagnostics(groups, len(rows), sigma_px)
    evidence = ImageEvidence(
        kept,
        part.residuals_px,
        part.pose_offset_px,
        constant,
        constant,
        quality=quality,
        misfit=misfit,
        retest=image_retest(part.xyz_cam, part.residuals_px),
    )
    return audit_image(evidence, config)


def audit_image(evidence: ImageEvidence, config: AuditConfig) -> ImageAudit:
    """Test the standardised residuals of the chosen and of the constant noise model, and decide."""
    chosen, constant, quality = evidence.chosen, evidence.constant, evidence.quality
    tests = normality_tests(chosen.z)
    diagnostics = _diagnostics(evidence, tests)
    decisions = decide_all(Measured.of([diagnostics]), config)
    advice = None
    if evidence.retest is not None:
        (advice,) = images_advice([quality], decisions, partial(_retested, evidence.retest), alpha=config.alpha)
    return ImageAudit(
        inliers=evidence.inliers,
        residuals_px=evidence.residuals_px.T,
        track_length=evidence.track_length,
        noise=chosen,
        tests=tests,
        constant=constant,
        constant_tests=tests if chosen is constant else normality_tests(constant.z),
        quality=quality,
        diagnostics=diagnostics,
        decision=decisions.decision(0),
        advised_camera_model=advice,
        expected_error_px=evidence.expected_error_px,
        implied=evidence.implied,
        outside=evidence.outside,
        pose=evidence.pose,
    )


def _retested(retest: Retest, _: int, camera: CameraRecord) -> MisfitTests:
    return retest(camera)


def _diagnostics(evidence: ImageEvidence, tests: NormalityTests) -> Diagnostics:
    """The numbers that decide, of all that is known."""
    z, camera = evidence.chosen.z, evidence.inliers.image.camera
    return Diagnostics(
        num_inliers=evidence.residuals_px.shape[1],
        noise=NoiseDiagnostics(len(z), tests.num_values, tests.ks_stat, tests.ks_p, bool(np.isfinite(z).all())),
        pose_offset_px=evidence.pose_offset_px,
        misfit=evidence.misfit,
        camera=evidence.camera or (None if evidence.quality is None else camera_diagnostics(evidence.quality)),
        largest_residual_px=longest_px(evidence.residuals_px),
        longer_side_px=0 if camera is None else max(camera.width, camera.height),
        unusable=unusable_reason(evidence.inliers.image),
        consistency=evidence.consistency,
        own=evidence.own,
        has_own=evidence.has_own,
        gains=evidence.gains,
        half_pixel=evidence.half_pixel,
        testimonies=evidence.testimonies,
    )


def camera_diagnostics(quality: CameraQuality) -> CameraDiagnostics:
    """The numbers of a camera that decide."""
    shape, known = quality.shape.plausibility, quality.identifiability
    return CameraDiagnostics(
        focal_over_size=shape.focal_over_size,
        folds_over=shape.folds_over,
        principal_point_px=shape.principal_point_px,
        size_px=shape.size_px,
        coverage=quality.coverage,
        occupied_cells=quality.occupied_cells,
        has_focal=known.has_focal,
        sd_focal_rel=known.sd_focal_rel,
        singular_share=known.parameters.singular_share,
        is_singular=known.parameters.is_singular,
        k1=known.k1 if known.has_k1 else None,
        sd_k1=known.sd_k1,
    )


def unusable_reason(image: ImageRecord) -> Reason | None:
    """What makes it impossible to project any point."""
    pose = np.concatenate([image.quat_cam_from_world_wxyz, image.translation_cam_from_world])
    num_odd = int(np.count_nonzero(~np.isfinite(pose)))
    if num_odd:
        return _unusable_reason(ReasonCode.NON_FINITE_POSE, f"{num_odd} of its 7 numbers", num_odd)
    if image.camera is None:
        return _unusable_reason(ReasonCode.MISSING_CAMERA, f"camera {image.camera_id}", None)
    params = image.camera.params
    num_odd = int(np.count_nonzero(~np.isfinite(params)))
    if num_odd:
        return _unusable_reason(ReasonCode.NON_FINITE_CAMERA, f"{num_odd} of {params.size} numbers", num_odd)
    if not is_usable(image.camera):
        values = ", ".join(f"{value:.4g}" for value in params)
        return _unusable_reason(ReasonCode.EXTREME_VALUES, f"{image.camera.model.name} {values}", None)
    if not is_sane(pose).all():
        return _unusable_reason(ReasonCode.EXTREME_VALUES, f"pose, up to {np.abs(pose).max():.4g}", None)
    return None


def _unusable_reason(code: ReasonCode, text: str, value: float | None) -> Reason:
    return Reason(code, Member.MISFIT, text, value, None, "count" if value is not None else "")
