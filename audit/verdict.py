"""From numbers to accepted, rejected or undetermined, with reasons (METHOD.md section 7; codes in docs/verdicts.md)."""

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
    """Why an image is not accepted. A closed list; each reason carries the number that triggered it."""

    KS_REJECTED = "ks_rejected"
    TOO_FEW_OBSERVATIONS = "too_few_observations"
    NON_FINITE_POSE = "non_finite_pose"
    NON_FINITE_CAMERA = "non_finite_camera"
    MISSING_CAMERA = "missing_camera"
    EXACT_PROJECTIONS = "exact_projections"
    NOISE_NOT_FITTED = "noise_not_fitted"


REASON_MEANINGS: dict[ReasonCode, str] = {
    ReasonCode.KS_REJECTED: "the standardised residuals do not look like N(0, 1): p-value, distance, number of values",
    ReasonCode.TOO_FEW_OBSERVATIONS: "fewer observations than a verdict needs (min_observations): which set, how many",
    ReasonCode.NON_FINITE_POSE: "the pose holds numbers that are not finite: how many of its seven",
    ReasonCode.NON_FINITE_CAMERA: "the camera parameters hold numbers that are not finite: how many",
    ReasonCode.MISSING_CAMERA: "the model has no camera of this id: the id",
    ReasonCode.EXACT_PROJECTIONS: "the 2D points are projections of the 3D points, not measurements: largest residual",
    ReasonCode.NOISE_NOT_FITTED: "the noise model could not be fitted: how many observations it had",
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
    """A verdict with the reasons for it; accepted has none."""

    verdict: Verdict
    reasons: tuple[Reason, ...] = ()


def judge_ks(ks_stat: float, ks_p: float, num_values: int, *, alpha: float) -> Judgement:
    """The paper's decision: rejected when ks_p < alpha."""
    if ks_p < alpha:
        detail = f"p = {ks_p:.3g} < {alpha:g}, D = {ks_stat:.4f}, {num_values} values"
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.KS_REJECTED, detail),))
    return Judgement(Verdict.ACCEPTED)


def combine(members: Sequence[Judgement]) -> Judgement:
    """Rejected if any member rejects, else undetermined if any member is, else accepted; all reasons, each once."""
    verdicts = {member.verdict for member in members}
    order = (Verdict.REJECTED, Verdict.UNDETERMINED, Verdict.ACCEPTED)
    verdict = next((v for v in order if v in verdicts), Verdict.UNDETERMINED)
    reasons = dict.fromkeys(reason for member in members for reason in member.reasons)
    return Judgement(verdict, tuple(reasons))
