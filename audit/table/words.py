"""The words of the result: verdicts, policies, misfit groups, reasons, severities. Everybody may import them.

Nobody types a verdict, a policy, a group or a reason code anywhere else. Finding codes of models are the loaders'
(`loaders.model.FindingCode`): most of them are found while reading.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, Literal

from sfm_audit.audit.table.witnesses import WITNESSES, Witness


class Verdict(StrEnum):
    """What is said about one image; undetermined is no pass."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    UNDETERMINED = "undetermined"


VERDICT_ORDER: Final = {Verdict.REJECTED: 0, Verdict.UNDETERMINED: 1, Verdict.ACCEPTED: 2}
"""The order in which verdicts win and are listed: one rejection rejects."""


class Member(StrEnum):
    """The questions that are decided one by one; each is a column of the images table."""

    MISFIT = "verdict_misfit"
    CAMERA = "verdict_camera"
    POSE = "verdict_pose"
    PLAUSIBLE = "plausible"
    NOISE = "verdict_noise"
    KS = "verdict_ks"
    OUTSIDE = "verdict_outside"

    @property
    def short(self) -> str:
        """The name in the columns num_<verdict>_<name> of the models table."""
        return self.value.removeprefix("verdict_")


MEMBER_QUESTIONS: Final[dict[Member, str]] = {
    Member.MISFIT: "Does the camera model hold?",
    Member.CAMERA: "Parameters right, all parts fit?",
    Member.POSE: "Is the pose at its optimum?",
    Member.PLAUSIBLE: "Is it a camera, and well observed?",
    Member.NOISE: "Is the noise visibly another one?",
    Member.KS: "Is the noise what the noise model says?",
    Member.OUTSIDE: "Do witnesses outside agree?",
}

PolicyName = Literal["standard", "camera", "full", "paper"]

POLICIES: Final[dict[PolicyName, tuple[Member, ...]]] = {
    "standard": (Member.MISFIT, Member.CAMERA, Member.POSE, Member.PLAUSIBLE, Member.NOISE, Member.OUTSIDE),
    "camera": (Member.MISFIT, Member.CAMERA, Member.POSE, Member.PLAUSIBLE),
    "full": tuple(Member),
    "paper": (Member.KS,),
}
"""Which members decide, in the order in which their reasons are listed; members that were not asked are skipped."""

POLICY_WORDS: Final[dict[PolicyName, str]] = {
    "standard": "all but verdict_ks",
    "camera": "misfit, camera, pose, plausible",
    "full": "all of them",
    "paper": "verdict_ks alone",
}


class MisfitGroup(StrEnum):
    """The ways in which a camera model can be wrong, in the order of the tables."""

    RADIAL = "radial"
    TANGENTIAL = "tangential"
    AFFINE = "affine"
    PRINCIPAL_POINT = "principal_point"
    ROLLING_SHUTTER = "rolling_shutter"
    SMOOTH = "smooth"


GROUPS: Final[tuple[MisfitGroup, ...]] = tuple(MisfitGroup)
LENS_GROUPS: Final = (MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE, MisfitGroup.PRINCIPAL_POINT)
"""verdict_misfit is undetermined only if none of these could be tested."""

GROUP_MEANINGS: Final[dict[MisfitGroup, str]] = {
    MisfitGroup.RADIAL: "radial distortion beyond r^2",
    MisfitGroup.TANGENTIAL: "tangential distortion",
    MisfitGroup.AFFINE: "aspect ratio and skew",
    MisfitGroup.PRINCIPAL_POINT: "principal point",
    MisfitGroup.ROLLING_SHUTTER: "a pose that changes from row to row",
    MisfitGroup.SMOOTH: "any smooth field over the image",
}


class MisfitStatus(StrEnum):
    """Why a group has a p-value, or why not.

    TESTED: p, px and rank are there.
    ABSORBED: rank 0, the fitted parameters span the group: the camera model has it, or these points cannot show it.
    NOT_ENOUGH_EVIDENCE: fewer than 4 observations (pooled: tracks) per rank, or fewer values than parameters.
    SINGULAR: the scores do not vary in every direction of the group, for instance because all residuals are zero.
    NOT_FINITE: a derivative is not finite.        NO_FIELDS: spherical cameras.
    NOT_ESTIMABLE: the effect is larger than the residuals it was taken from can hold: a numerical fault, no verdict.
    NO_COLUMNS: the image takes no part in the joint system (too few inliers, unknown noise, parts that disagree).
    EXCLUDED: the image's pose or camera is wrong otherwise; its fields are not asked for.
    """

    TESTED = "tested"
    ABSORBED = "absorbed"
    NOT_ENOUGH_EVIDENCE = "not enough evidence"
    SINGULAR = "scores singular"
    NOT_FINITE = "derivatives not finite"
    NO_FIELDS = "spherical camera"
    NOT_ESTIMABLE = "effect not estimable"
    NO_COLUMNS = "not in the joint system"
    EXCLUDED = "pose or camera wrong otherwise"


class Severity(StrEnum):
    """How bad it is that an image is rejected: hard first (method.md section 11)."""

    HARD = "hard"
    MEDIUM = "medium"
    WEAK = "weak"


SEVERITY_ORDER: Final = {Severity.HARD: 0, Severity.MEDIUM: 1, Severity.WEAK: 2}


class ReasonCode(StrEnum):
    """Why an image is not accepted, and remarks. A closed list; each reason carries the number that triggered it."""

    KS_REJECTED = "ks_rejected"
    TOO_FEW_OBSERVATIONS = "too_few_observations"
    NON_FINITE_POSE = "non_finite_pose"
    NON_FINITE_CAMERA = "non_finite_camera"
    MISSING_CAMERA = "missing_camera"
    EXTREME_VALUES = "extreme_values"
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
    INCONSISTENT = "inconsistent"
    POINTS_BEHIND = "points_behind"
    CAMERA_NOT_OPTIMAL = "camera_not_optimal"
    CAMERA_NOT_TESTED = "camera_not_tested"
    MISFIT_WITHOUT_WORTH = "misfit_without_worth"
    NOISE_DIFFERS = "noise_differs"
    PIXEL_CONVENTION = "pixel_convention"
    DEGENERATE_INPUT = "degenerate_input"
    PAIRS_DISAGREE = "pairs_disagree"
    FOLD_DISAGREES = "fold_disagrees"
    REFERENCE_DISAGREES = "reference_disagrees"
    PRIORS_DISAGREE = "priors_disagree"


MISFIT_CODES: Final[dict[MisfitGroup, ReasonCode]] = {group: ReasonCode(f"misfit_{group}") for group in GROUPS}

WITNESS_CODES: Final[dict[Witness, ReasonCode]] = {
    Witness.PAIRS: ReasonCode.PAIRS_DISAGREE,
    Witness.FOLD: ReasonCode.FOLD_DISAGREES,
    Witness.REFERENCE: ReasonCode.REFERENCE_DISAGREES,
    Witness.PRIORS: ReasonCode.PRIORS_DISAGREE,
}

_ALL: Final = tuple(Member)


@dataclass(frozen=True, slots=True)
class ReasonWords:
    """What a reason code means.

    members: the verdicts it speaks for.    makes: what it makes of them; None: a remark, which decides nothing.
    meaning: one line, and what stands after the colon.    note: of what it makes, where that needs words.
    """

    members: tuple[Member, ...]
    makes: Verdict | None
    meaning: str
    note: str = ""


def _rejects(meaning: str, *members: Member, note: str = "") -> ReasonWords:
    return ReasonWords(members, Verdict.REJECTED, meaning, note)


def _leaves_open(meaning: str, *members: Member, note: str = "") -> ReasonWords:
    return ReasonWords(members, Verdict.UNDETERMINED, meaning, note)


def _remarks(meaning: str, *members: Member, note: str = "") -> ReasonWords:
    return ReasonWords(members, None, meaning, note)


def _testifies(witness: Witness, meaning: str) -> ReasonWords:
    may_reject = WITNESSES[witness].may_reject
    makes = Verdict.REJECTED if may_reject else Verdict.UNDETERMINED
    note = "" if may_reject else "until its false alarms on real photos are known to be rare"
    return ReasonWords((Member.OUTSIDE,), makes, meaning, note)


REASONS: Final[dict[ReasonCode, ReasonWords]] = {
    ReasonCode.KS_REJECTED: _rejects(
        "the standardised residuals do not look like N(0, 1): p-value, distance, number of values", Member.KS
    ),
    ReasonCode.TOO_FEW_OBSERVATIONS: _leaves_open(
        "fewer observations than a verdict needs (min_observations): which set, how many", *_ALL
    ),
    ReasonCode.NON_FINITE_POSE: _leaves_open(
        "the pose holds numbers that are not finite: how many of its seven", *_ALL
    ),
    ReasonCode.NON_FINITE_CAMERA: _leaves_open(
        "the camera parameters hold numbers that are not finite: how many", *_ALL
    ),
    ReasonCode.EXTREME_VALUES: _leaves_open(
        "camera or pose hold finite numbers that nothing can be calculated with (above 1e12, or a focal length of 0)",
        *_ALL,
    ),
    ReasonCode.MISSING_CAMERA: _leaves_open("the model has no camera of this id: the id", *_ALL),
    ReasonCode.EXACT_PROJECTIONS: _leaves_open(
        "the 2D points are projections of the 3D points, not measurements (feed-forward networks write such): "
        "largest residual",
        *(Member.MISFIT, Member.CAMERA, Member.NOISE, Member.KS),
    ),
    ReasonCode.NOISE_NOT_FITTED: _leaves_open(
        "the noise model could not be fitted: how many observations it had", Member.PLAUSIBLE, Member.NOISE, Member.KS
    ),
    ReasonCode.NON_FINITE_DERIVATIVES: _leaves_open(
        "derivatives of the projection are not finite: how many observations there are", Member.POSE, Member.PLAUSIBLE
    ),
    ReasonCode.MISFIT_RADIAL: _rejects(
        "residuals bend with the radius as no parameter of this camera does: px, q", Member.MISFIT
    ),
    ReasonCode.MISFIT_TANGENTIAL: _rejects("residuals follow a decentred lens: px, q", Member.MISFIT),
    ReasonCode.MISFIT_AFFINE: _rejects("residuals follow another aspect ratio or skew: px, q", Member.MISFIT),
    ReasonCode.MISFIT_PRINCIPAL_POINT: _rejects("residuals follow another principal point: px, q", Member.MISFIT),
    ReasonCode.MISFIT_ROLLING_SHUTTER: _rejects(
        "residuals follow a pose that changes from row to row: px, q", Member.MISFIT
    ),
    ReasonCode.MISFIT_SMOOTH: _rejects(
        "residuals follow a smooth field over the image that has no name: px, q", Member.MISFIT
    ),
    ReasonCode.SHARED_CAMERA: _rejects(
        "the camera as a whole is at fault, all its images together say so: group, px, q",
        Member.MISFIT,
        note="beside the group",
    ),
    ReasonCode.MISFIT_NOT_TESTED: _leaves_open(
        "groups that could not be tested, and why (decides only if no lens group ran)",
        Member.MISFIT,
        note="where no lens group ran, else a remark",
    ),
    ReasonCode.POSE_NOT_OPTIMAL: _rejects(
        "the pose is not at the optimum of the image's own residuals: RMS it would remove, px", Member.POSE
    ),
    ReasonCode.FOCAL_OUT_OF_RANGE: _rejects("no plausible focal length: f / max(width, height)", Member.PLAUSIBLE),
    ReasonCode.DISTORTION_FOLDS: _rejects("the distortion folds inside the image: the image size", Member.PLAUSIBLE),
    ReasonCode.PRINCIPAL_POINT_OUTSIDE: _rejects(
        "the principal point lies outside the image: where, px", Member.PLAUSIBLE
    ),
    ReasonCode.FOCAL_NOT_IDENTIFIED: _leaves_open(
        "the observations do not fix the focal length: sd_f / f, or how singular they are", Member.PLAUSIBLE
    ),
    ReasonCode.K1_NOT_IDENTIFIED: _remarks(
        "|k1| is below two of its standard deviations (decides nothing): k1 and its sd", Member.PLAUSIBLE
    ),
    ReasonCode.LOW_COVERAGE: _leaves_open(
        "the inliers see too little of the image: share of their convex hull", Member.PLAUSIBLE
    ),
    ReasonCode.FEW_OCCUPIED_CELLS: _leaves_open(
        "the inliers lie in too few cells of the image: how many, and how many are needed", Member.PLAUSIBLE
    ),
    ReasonCode.FRONTO_PARALLEL: _remarks(
        "the points lie in a plane nearly parallel to the image: tilt, correlation of f",
        Member.PLAUSIBLE,
        note="of calibrate",
    ),
    ReasonCode.INCONSISTENT: _rejects(
        "camera, pose, points and 2D points do not belong together: what was found, and the cause where it is known",
        Member.CAMERA,
    ),
    ReasonCode.POINTS_BEHIND: _leaves_open(
        "all observations of the model, or all of the few of the image, lie behind: axes flipped, or poses inverted?",
        *_ALL,
    ),
    ReasonCode.CAMERA_NOT_OPTIMAL: _rejects(
        "a parameter of the camera is not where adjusting everything would put it: stored and implied value, sd, px",
        Member.CAMERA,
    ),
    ReasonCode.CAMERA_NOT_TESTED: _leaves_open(
        "the camera takes no part in the joint system: too few inliers, unknown noise or odd derivatives", Member.CAMERA
    ),
    ReasonCode.MISFIT_WITHOUT_WORTH: _remarks(
        "a misfit above min_effect that would change pose and focal length by next to nothing (decides nothing): px, "
        "degrees, share of f",
        Member.MISFIT,
    ),
    ReasonCode.NOISE_DIFFERS: _rejects(
        "the noise is visibly another one: D - 1.36 / sqrt(N), its limit, number of values", Member.NOISE
    ),
    ReasonCode.PIXEL_CONVENTION: _remarks(
        "half a pixel between 2D points and cameras in all images explains it (decides nothing): which number",
        *(Member.POSE, Member.NOISE),
    ),
    ReasonCode.DEGENERATE_INPUT: _leaves_open(
        "the correspondences determine no camera: in which way, and the number that says so", *_ALL, note="of calibrate"
    ),
    ReasonCode.PAIRS_DISAGREE: _testifies(
        Witness.PAIRS, "verified matches with covisible neighbours contradict the cameras: how many pairs, q"
    ),
    ReasonCode.FOLD_DISAGREES: _testifies(
        Witness.FOLD, "images that should see the same points see two different sets of them: score, group"
    ),
    ReasonCode.REFERENCE_DISAGREES: _testifies(
        Witness.REFERENCE, "the pose is not where the reference has it: how far, and the limit"
    ),
    ReasonCode.PRIORS_DISAGREE: _testifies(Witness.PRIORS, "the centre is not where its prior has it: how far, q"),
}

UNUSABLE: Final = frozenset(
    {
        ReasonCode.NON_FINITE_POSE,
        ReasonCode.NON_FINITE_CAMERA,
        ReasonCode.MISSING_CAMERA,
        ReasonCode.EXTREME_VALUES,
    }
)
"""Nothing can be projected, whatever the settings are: in the way of every question."""


@dataclass(frozen=True, slots=True)
class Reason:
    """One reason, and the number that triggered it.

    member: the verdict it speaks for.    value, limit: in ``unit`` (px, 1, count, ...), None where there is none.
    group: the misfit group it is about.    text: the same in words, as the tables show it after the code.
    """

    code: ReasonCode
    member: Member
    text: str
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    group: MisfitGroup | None = None

    @property
    def verdict(self) -> str:
        """The column of its verdict, as the column ``reason_details`` names it."""
        return str(self.member)

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


def is_remark(code: str, row: Mapping[str, Any]) -> bool:
    """Whether a reason code decides nothing in the image of this row (docs/verdicts.md); unknown codes decide."""
    if code == ReasonCode.MISFIT_NOT_TESTED:
        return bool(row[Member.MISFIT] != Verdict.UNDETERMINED)
    words = REASONS.get(code)  # type: ignore[call-overload] # a code of a later version is a string like any other
    return words is not None and words.makes is None


def strongest(verdicts: Iterable[str | None]) -> Verdict:
    """Return rejected if any verdict rejects, else undetermined if any is, else accepted; None was not asked.

    Undetermined where nothing was asked, and where a table holds another word.
    """
    said = [Verdict(each) if each in VERDICT_ORDER else Verdict.UNDETERMINED for each in verdicts if each is not None]
    return min(said, key=VERDICT_ORDER.__getitem__, default=Verdict.UNDETERMINED)


def verdict_under(policy: PolicyName, row: Mapping[str, Any]) -> Verdict:
    """Return what a policy makes of the member verdicts in a row of the images table."""
    return strongest(row.get(member) for member in POLICIES[policy])
