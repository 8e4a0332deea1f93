"""One image, all questions: noise, tests of normality, verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from audit.config import AuditConfig
from audit.normality import NormalityTests, normality_tests
from audit.residuals import image_residuals
from audit.standardise import ImageNoise, constant_noise
from audit.verdict import Judgement, Reason, ReasonCode, Verdict, combine, judge_ks
from loaders.arrays import FloatArray, IntArray
from loaders.model import ImageRecord, InlierSet

_EXACT_SHARE = 1e-9  # residuals below this share of the image size are rounding, not measurement


@dataclass(frozen=True, slots=True, eq=False)
class ImageAudit:
    """What the audit knows about one image.

    inliers: the 2D-3D inliers.          residuals_px: (n, 2) observed - projected.       pose_offset_px: METHOD.md 6.
    track_length: (n,) audited observations of each inlier's track; None where the points are independent of the image.
    noise, tests: under the chosen noise model.          constant, constant_tests: one scale for all raw residuals.
    ks: the paper's verdict.                             judgement: the verdict of the policy, with all reasons.
    """

    inliers: InlierSet
    residuals_px: FloatArray
    pose_offset_px: float
    track_length: IntArray | None
    noise: ImageNoise
    tests: NormalityTests
    constant: ImageNoise
    constant_tests: NormalityTests
    ks: Judgement
    judgement: Judgement

    @property
    def image(self) -> ImageRecord:
        """The image that was audited."""
        return self.inliers.image

    @property
    def verdict(self) -> Verdict:
        """The verdict of the policy."""
        return self.judgement.verdict


def audit_inliers(inliers: InlierSet, config: AuditConfig | None = None) -> ImageAudit:
    """Audit one image on its own, its 3D points taken as given: noise model ``constant``.

    Parameters
    ----------
    inliers : observed points and the 3D points they belong to; observations that turn out to be behind the camera or
        without a finite projection are counted and left out, as METHOD.md section 1 says
    config : thresholds; the defaults when None. Its ``noise`` is not used: other noise models need the tracks of the
        whole model (`audit.ModelAuditor`)

    Notes
    -----
    With points that were triangulated from this very image the residuals are shrunk (METHOD.md section 3a).
    """
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
    return judged(kept, part.residuals_px, part.pose_offset_px, constant, constant, None, config or AuditConfig())


def judged(
    inliers: InlierSet,
    residuals_px: FloatArray,
    pose_offset_px: float,
    constant: ImageNoise,
    chosen: ImageNoise,
    track_length: IntArray | None,
    config: AuditConfig,
) -> ImageAudit:
    """Test the chosen and the constant noise model's standardised residuals and judge; residuals_px is (2, n)."""
    tests = normality_tests(chosen.z)
    constant_tests = tests if chosen is constant else normality_tests(constant.z)
    ks = _judge(inliers, residuals_px, chosen, tests, config)
    return ImageAudit(
        inliers,
        residuals_px.T,
        pose_offset_px,
        track_length,
        chosen,
        tests,
        constant,
        constant_tests,
        ks,
        combine([ks]),
    )


def _judge(
    inliers: InlierSet, residuals_px: FloatArray, noise: ImageNoise, tests: NormalityTests, config: AuditConfig
) -> Judgement:
    """Return the paper's verdict, or undetermined with the first reason that stands in its way."""
    obstacle = (
        _unusable(inliers.image) or _too_few(residuals_px, noise, config) or _no_noise(inliers, residuals_px, noise)
    )
    if obstacle:
        return Judgement(Verdict.UNDETERMINED, (obstacle,))
    return judge_ks(tests.ks_stat, tests.ks_p, tests.num_values, alpha=config.alpha)


def _unusable(image: ImageRecord) -> Reason | None:
    """What makes it impossible to project any point."""
    pose = np.concatenate([image.quat_cam_from_world_wxyz, image.translation_cam_from_world])
    if not np.isfinite(pose).all():
        return Reason(ReasonCode.NON_FINITE_POSE, f"{np.count_nonzero(~np.isfinite(pose))} of its 7 numbers")
    if image.camera is None:
        return Reason(ReasonCode.MISSING_CAMERA, f"camera {image.camera_id}")
    params = image.camera.params
    if not np.isfinite(params).all():
        return Reason(
            ReasonCode.NON_FINITE_CAMERA, f"{np.count_nonzero(~np.isfinite(params))} of {params.size} numbers"
        )
    return None


def _too_few(residuals_px: FloatArray, noise: ImageNoise, config: AuditConfig) -> Reason | None:
    if len(noise.z) >= config.min_observations:
        return None
    return Reason(
        ReasonCode.TOO_FEW_OBSERVATIONS,
        f"{len(noise.z)} standardised of {residuals_px.shape[1]} inliers, {config.min_observations} needed",
    )


def _no_noise(inliers: InlierSet, residuals_px: FloatArray, noise: ImageNoise) -> Reason | None:
    """What makes the residuals no measurements, or their scale unknown."""
    camera, largest = inliers.image.camera, float(np.abs(residuals_px).max())
    if camera is not None and largest <= _EXACT_SHARE * max(camera.width, camera.height):
        return Reason(ReasonCode.EXACT_PROJECTIONS, f"largest residual {largest:.2g} px")
    if not np.isfinite(noise.z).all():
        return Reason(ReasonCode.NOISE_NOT_FITTED, f"{len(noise.z)} observations")
    return None
