"""One image, all questions: noise, tests of normality, verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.camera_quality.diagnostics import CameraFacts, CameraShape, camera_facts
from sfm_audit.audit.camera_quality.plausibility import PlausibilityLimits, judge_plausible, judge_pose
from sfm_audit.audit.config import AuditConfig, PolicyName
from sfm_audit.audit.decision.misfit import Misfit, find_misfit, judge_misfit
from sfm_audit.audit.decision.verdict import Judgement, Reason, ReasonCode, Verdict, combine, judge_ks
from sfm_audit.audit.engine.camera import image_advice
from sfm_audit.audit.inliers.residuals import image_residuals
from sfm_audit.audit.misfit import MisfitTests, Retest, image_retest
from sfm_audit.audit.misfit.peeling import Significance
from sfm_audit.audit.noise.standardise import ImageNoise, constant_noise
from sfm_audit.audit.normality import NormalityTests, normality_tests
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import ImageRecord, InlierSet

_EXACT_SHARE = 1e-9  # residuals below this share of the image size are rounding, not measurement


@dataclass(frozen=True, slots=True)
class Judgements:
    """The four verdicts on one image."""

    ks: Judgement
    misfit: Judgement
    pose: Judgement
    plausible: Judgement

    def under(self, policy: PolicyName) -> Judgement:
        """Return the verdict of a policy with the reasons of its members."""
        camera = [self.misfit, self.pose, self.plausible]
        members: dict[PolicyName, list[Judgement]] = {
            "paper": [self.ks],
            "camera": camera,
            "full": [*camera, self.ks],
        }
        return combine(members[policy])


@dataclass(frozen=True, slots=True, eq=False)
class CameraOpinion:
    """What was decided about an image's camera after peeling.

    num_tested: inliers that the final tests used.           shared: the reason that its camera as a whole is at fault.
    """

    misfit: Misfit
    advised_camera_model: str | None
    num_tested: int
    shared: Reason | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImageAudit:
    """What the audit knows about one image.

    inliers: the 2D-3D inliers.          residuals_px: (n, 2) observed - projected.       pose_offset_px: method.md 6.
    track_length: (n,) audited observations of each inlier's track; None where the points are independent of the image.
    noise, tests: under the chosen noise model.          constant, constant_tests: one scale for all raw residuals.
    facts, opinion: on the camera, as the model stands and after peeling; both None without inliers.
    judgement: the verdict of the policy, with the reasons of its members.
    """

    inliers: InlierSet
    residuals_px: FloatArray
    pose_offset_px: float
    track_length: IntArray | None
    noise: ImageNoise
    tests: NormalityTests
    constant: ImageNoise
    constant_tests: NormalityTests
    facts: CameraFacts | None
    opinion: CameraOpinion | None
    judgements: Judgements
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
    """Audit one image on its own, its 3D points taken as independent of it: noise model ``constant``.

    Parameters
    ----------
    inliers : observed points and the 3D points they belong to; observations that turn out to be behind the camera or
        without a finite projection are counted and left out, as method.md section 1 says
    config : thresholds; the defaults when None. Its ``noise`` is not used: other noise models need the tracks of the
        whole model (`audit.ModelAuditor`)

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
    camera = inliers.image.camera
    shape = None if camera is None else CameraShape.of(camera)
    facts, opinion = None, None
    if shape is not None:
        sigma_px = constant.sigma_constant_px
        facts = camera_facts(shape, kept.xy_px, part.xyz_cam.T, part.residuals_px, sigma_px, config.grid)
    if facts is not None:
        opinion = opinion_of(
            facts,
            facts.misfit,
            Significance.of([facts.misfit]).q[0],
            len(rows),
            image_retest(part.xyz_cam.T, part.residuals_px),
            sigma_px,
            config,
        )
    return judged(kept, part.residuals_px, part.pose_offset_px, constant, constant, None, facts, opinion, config)


def opinion_of(
    facts: CameraFacts,
    tests: MisfitTests,
    q: FloatArray,
    num_tested: int,
    retest: Retest,
    sigma_px: float,
    config: AuditConfig,
) -> CameraOpinion:
    """Form the opinion from the final tests, their q (6,), and the number and the retest of the inliers they used."""
    tau_px = config.tau_px(sigma_px)
    misfit = find_misfit(tests, q, num_observations=num_tested, sigma_px=sigma_px, alpha=config.alpha, tau_px=tau_px)
    advice = image_advice(facts, misfit, retest, alpha=config.alpha, tau_px=tau_px)
    return CameraOpinion(misfit, advice, num_tested)


def judged(
    inliers: InlierSet,
    residuals_px: FloatArray,
    pose_offset_px: float,
    constant: ImageNoise,
    chosen: ImageNoise,
    track_length: IntArray | None,
    facts: CameraFacts | None,
    opinion: CameraOpinion | None,
    config: AuditConfig,
) -> ImageAudit:
    """Test the chosen and the constant noise model's standardised residuals and judge; residuals_px is (2, n)."""
    tests = normality_tests(chosen.z)
    constant_tests = tests if chosen is constant else normality_tests(constant.z)
    judgements = _judge(inliers, residuals_px, pose_offset_px, chosen, tests, facts, opinion, config)
    return ImageAudit(
        inliers,
        residuals_px.T,
        pose_offset_px,
        track_length,
        chosen,
        tests,
        constant,
        constant_tests,
        facts,
        opinion,
        judgements,
        judgements.under(config.policy),
    )


def _judge(
    inliers: InlierSet,
    residuals_px: FloatArray,
    pose_offset_px: float,
    noise: ImageNoise,
    tests: NormalityTests,
    facts: CameraFacts | None,
    opinion: CameraOpinion | None,
    config: AuditConfig,
) -> Judgements:
    """Return all four verdicts; each is undetermined with the first reason that stands in its way."""
    unusable = _unusable(inliers.image)
    if unusable is not None:
        nothing = Judgement(Verdict.UNDETERMINED, (unusable,))
        return Judgements(nothing, nothing, nothing, nothing)
    num_inliers = residuals_px.shape[1]
    exact = _exact(inliers, residuals_px)
    no_ks = _too_few("standardised", len(noise.z), num_inliers, config) or exact or no_noise(noise)
    ks = judge_ks(tests.ks_stat, tests.ks_p, tests.num_values, alpha=config.alpha, min_distance=config.min_ks_distance)
    if no_ks is not None:
        ks = Judgement(Verdict.UNDETERMINED, (no_ks,))
    limits = limits_of(config)
    if facts is None or opinion is None:
        nothing = Judgement(Verdict.UNDETERMINED, (_few("inliers", num_inliers, config),))
        return Judgements(ks, nothing, judge_pose(pose_offset_px, num_inliers, limits), nothing)
    no_misfit = _too_few("clean", opinion.num_tested, num_inliers, config) or exact
    misfit = judge_misfit(opinion.misfit)
    if no_misfit is not None:
        misfit = Judgement(Verdict.UNDETERMINED, (no_misfit,))
    elif opinion.shared is not None and misfit.verdict is Verdict.REJECTED:
        misfit = Judgement(Verdict.REJECTED, (opinion.shared, *misfit.reasons))
    plausible = judge_plausible(
        facts.shape.plausibility,
        facts.identifiability,
        coverage=facts.coverage,
        occupied_cells=facts.occupied_cells,
        num_inliers=num_inliers,
        limits=limits,
    )
    return Judgements(ks, misfit, judge_pose(pose_offset_px, num_inliers, limits), plausible)


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


def _few(what: str, num: int, config: AuditConfig) -> Reason:
    return Reason(ReasonCode.TOO_FEW_OBSERVATIONS, f"{num} {what}, {config.min_observations} needed")


def _too_few(kind: str, num: int, num_inliers: int, config: AuditConfig) -> Reason | None:
    if num >= config.min_observations:
        return None
    return _few("inliers" if num == num_inliers else f"{kind} of {num_inliers} inliers", num, config)


def _exact(inliers: InlierSet, residuals_px: FloatArray) -> Reason | None:
    camera = inliers.image.camera
    return None if camera is None else exact_projections(residuals_px, max(camera.width, camera.height))


def exact_projections(residuals_px: FloatArray, longer_side_px: int) -> Reason | None:
    """Say what makes the 2D points no measurements; None where they are."""
    largest = float(np.abs(residuals_px).max(initial=0.0))
    if largest <= _EXACT_SHARE * longer_side_px:
        return Reason(ReasonCode.EXACT_PROJECTIONS, f"largest residual {largest:.2g} px")
    return None


def no_noise(noise: ImageNoise) -> Reason | None:
    """Say that nothing could be standardised; None where it could."""
    if np.isfinite(noise.z).all():
        return None
    return Reason(ReasonCode.NOISE_NOT_FITTED, f"{len(noise.z)} observations")


def limits_of(config: AuditConfig) -> PlausibilityLimits:
    """Return the thresholds of `audit.camera_quality.plausibility` that a config sets."""
    return PlausibilityLimits(
        min_focal_over_size=config.min_focal_over_size,
        max_focal_over_size=config.max_focal_over_size,
        max_sd_focal_rel=config.max_sd_focal_rel,
        min_k1_sds=config.min_k1_sds,
        min_coverage=config.min_coverage,
        min_occupied_cells=config.min_occupied_cells,
        min_observations=config.min_observations,
        max_pose_offset_px=config.pose_offset_threshold_px,
    )
