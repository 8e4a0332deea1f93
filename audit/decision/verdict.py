"""From numbers to accepted, rejected or undetermined, with reasons (method.md section 7; codes in docs/verdicts.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """What the audit says about one image."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    UNDETERMINED = "undetermined"


class ReasonCode(StrEnum):
    """Why an image is not accepted, and remarks. A closed list; each reason carries the number that triggered it."""

    KS_REJECTED = "ks_rejected"
    TOO_FEW_OBSERVATIONS = "too_few_observations"
    NON_FINITE_POSE = "non_finite_pose"
    NON_FINITE_CAMERA = "non_finite_camera"
    MISSING_CAMERA = "missing_camera"
    EXACT_PROJECTIONS = "exact_projections"
    NOISE_NOT_FITTED = "noise_not_fitted"
    NON_FINITE_DERIVATIVES = "non_finite_derivatives"
    MISFIT_RADIAL = "misfit_radial"
    MISFIT_TANGENTIAL = "misfit_tangential"
    MISFIT_AFFINE = "misfit_affine"
    MISFIT_PRINCIPAL_POINT = "misfit_principal_point"
    MISFIT_ROLLING_SHUTTER = "misfit_rolling_shutter"
    MISFIT_SMOOTH = "misfit_smooth"
    SHARED_CAMERA = "shared_camera"
    MISFIT_NOT_TESTED = "misfit_not_tested"
    POSE_NOT_OPTIMAL = "pose_not_optimal"
    FOCAL_OUT_OF_RANGE = "focal_out_of_range"
    DISTORTION_FOLDS = "distortion_folds"
    PRINCIPAL_POINT_OUTSIDE = "principal_point_outside"
    FOCAL_NOT_IDENTIFIED = "focal_not_identified"
    K1_NOT_IDENTIFIED = "k1_not_identified"
    LOW_COVERAGE = "low_coverage"
    FEW_OCCUPIED_CELLS = "few_occupied_cells"
    FRONTO_PARALLEL = "fronto_parallel"
    DEGENERATE_INPUT = "degenerate_input"


REASON_MEANINGS: dict[ReasonCode, str] = {
    ReasonCode.KS_REJECTED: "the standardised residuals do not look like N(0, 1): p-value, distance, number of values",
    ReasonCode.TOO_FEW_OBSERVATIONS: "fewer observations than a verdict needs (min_observations): which set, how many",
    ReasonCode.NON_FINITE_POSE: "the pose holds numbers that are not finite: how many of its seven",
    ReasonCode.NON_FINITE_CAMERA: "the camera parameters hold numbers that are not finite: how many",
    ReasonCode.MISSING_CAMERA: "the model has no camera of this id: the id",
    ReasonCode.EXACT_PROJECTIONS: "the 2D points are projections of the 3D points, not measurements: largest residual",
    ReasonCode.NOISE_NOT_FITTED: "the noise model could not be fitted: how many observations it had",
    ReasonCode.NON_FINITE_DERIVATIVES: "derivatives of the projection are not finite: how many observations there are",
    ReasonCode.MISFIT_RADIAL: "residuals bend with the radius as no parameter of this camera does: px, q",
    ReasonCode.MISFIT_TANGENTIAL: "residuals follow a decentred lens: px, q",
    ReasonCode.MISFIT_AFFINE: "residuals follow another aspect ratio or skew: px, q",
    ReasonCode.MISFIT_PRINCIPAL_POINT: "residuals follow another principal point: px, q",
    ReasonCode.MISFIT_ROLLING_SHUTTER: "residuals follow a pose that changes from row to row: px, q",
    ReasonCode.MISFIT_SMOOTH: "residuals follow a smooth field over the image that has no name: px, q",
    ReasonCode.SHARED_CAMERA: "the camera as a whole is at fault, all its images together say so: group, px, q",
    ReasonCode.MISFIT_NOT_TESTED: "groups that could not be tested, and why (decides only if no lens group ran)",
    ReasonCode.POSE_NOT_OPTIMAL: "the pose is not at the optimum of the image's own residuals: RMS it would remove, px",
    ReasonCode.FOCAL_OUT_OF_RANGE: "no plausible focal length: f / max(width, height)",
    ReasonCode.DISTORTION_FOLDS: "the distortion folds inside the image: the image size",
    ReasonCode.PRINCIPAL_POINT_OUTSIDE: "the principal point lies outside the image: where, px",
    ReasonCode.FOCAL_NOT_IDENTIFIED: "the observations do not fix the focal length: sd_f / f, or how singular they are",
    ReasonCode.K1_NOT_IDENTIFIED: "|k1| is below two of its standard deviations (decides nothing): k1 and its sd",
    ReasonCode.LOW_COVERAGE: "the inliers see too little of the image: share of their convex hull",
    ReasonCode.FEW_OCCUPIED_CELLS: "the inliers lie in too few cells of the image: how many, and how many are needed",
    ReasonCode.FRONTO_PARALLEL: "the points lie in a plane nearly parallel to the image: tilt, correlation of f",
    ReasonCode.DEGENERATE_INPUT: "the correspondences determine no camera: in which way, and the number that says so",
}


@dataclass(frozen=True, slots=True)
class Reason:
    """One reason: its code and, in words, the number that triggered it."""

    code: ReasonCode
    detail: str

    def __str__(self) -> str:
        return f"{self.code}: {self.detail}"


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict with the reasons for it; an accepted image may carry remarks that decide nothing."""

    verdict: Verdict
    reasons: tuple[Reason, ...] = ()


def judge_ks(ks_stat: float, ks_p: float, num_values: int, *, alpha: float, min_distance: float = 0.0) -> Judgement:
    """The paper's decision: rejected when ks_p < alpha; and, where asked for, D is larger than ``min_distance``."""
    if ks_p < alpha and ks_stat > min_distance:
        detail = f"p = {ks_p:.3g} < {alpha:g}, D = {ks_stat:.4f}, {num_values} values"
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.KS_REJECTED, detail),))
    return Judgement(Verdict.ACCEPTED)


def combine(members: Sequence[Judgement]) -> Judgement:
    """Return rejected if any member rejects, else undetermined if any member is, else accepted; reasons each once."""
    verdicts = {member.verdict for member in members}
    order = (Verdict.REJECTED, Verdict.UNDETERMINED, Verdict.ACCEPTED)
    verdict = next((v for v in order if v in verdicts), Verdict.UNDETERMINED)
    reasons = dict.fromkeys(reason for member in members for reason in member.reasons)
    return Judgement(verdict, tuple(reasons))
