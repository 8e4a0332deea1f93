"""Which misfit is there, which is material, and which is the cause? (method.md sections 5 and 7).

Of many images at once: groups are columns, in the order of GROUPS.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.diagnostics import GroupDiagnostics, MisfitDiagnostics, Worth
from sfm_audit.audit.decision.judged import About, Judged, Said, say
from sfm_audit.audit.decision.measured import STATUS_CODES, STATUSES, Measured, MeasuredMisfit
from sfm_audit.audit.decision.members import exact_or_few, too_few
from sfm_audit.audit.table.thresholds import (
    MAX_WORTHLESS_TAUS,
    MIN_SHIFT_WORTH_CENTRE,
    MIN_SHIFT_WORTH_FOCAL_REL,
    WEAK_WORTH_DEG,
    WEAK_WORTH_FOCAL_REL,
)
from sfm_audit.audit.table.words import (
    GROUPS,
    LENS_GROUPS,
    MISFIT_CODES,
    Member,
    MisfitGroup,
    MisfitStatus,
    ReasonCode,
    Verdict,
)
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_SHIFTS = frozenset({MisfitGroup.PRINCIPAL_POINT, MisfitGroup.TANGENTIAL})
_SAYS_NOTHING = frozenset({MisfitStatus.TESTED, MisfitStatus.ABSORBED})
_IS_SHIFT = np.array([group in _SHIFTS for group in GROUPS])
_IS_LENS = np.array([group in LENS_GROUPS for group in GROUPS])
_IS_NO_TEST = np.array([status not in _SAYS_NOTHING for status in STATUSES])


@dataclass(frozen=True, slots=True)
class MisfitDecision:
    """What is wrong with a camera: the named cause, and what is material.

    group: the cause, None where no group is significant.    px, q: the cause's effect and q, else NaN.
    material: significant groups with an effect above tau_px.    also: the other material ones with their effects.
    untested: groups that could not be tested, and why.
    """

    group: MisfitGroup | None
    px: float
    q: float
    tau_px: float
    material: tuple[MisfitGroup, ...]
    also: tuple[tuple[MisfitGroup, float], ...]
    untested: tuple[tuple[MisfitGroup, MisfitStatus], ...]


@dataclass(frozen=True, slots=True, eq=False)
class MisfitDecisions:
    """`MisfitDecision` of n images: cause (n,) places in GROUPS, -1 none; material (n, 6); px, q, tau_px (n,).

    worth: (n, 3) of the cause; NaN where there is none or it is not known.
    """

    measured: MeasuredMisfit
    cause: IntArray
    px: FloatArray
    q: FloatArray
    tau_px: FloatArray
    material: BoolArray
    worth: FloatArray

    @property
    def largest_px(self) -> FloatArray:
        """(n,) the largest effect among the material groups, that of the cause where none is; NaN without a cause."""
        return np.asarray(np.maximum(self.px, np.where(self.material, self.measured.px, -math.inf).max(axis=1)))

    @property
    def untested(self) -> BoolArray:
        """(n, 6) groups that could not be tested."""
        return _IS_NO_TEST[self.measured.status]

    def record(self, i: int) -> MisfitDecision | None:
        """Return what is decided of one image; None where nothing was tested."""
        measured, cause = self.measured, int(self.cause[i])
        if not measured.known[i]:
            return None
        material = tuple(GROUPS[k] for k in np.flatnonzero(self.material[i]))
        untested = tuple((GROUPS[k], STATUSES[measured.status[i, k]]) for k in np.flatnonzero(self.untested[i]))
        group = GROUPS[cause] if cause >= 0 else None
        numbers = float(self.px[i]), float(self.q[i]), float(self.tau_px[i])
        return MisfitDecision(group, *numbers, material, tuple(self._also(i)), untested)

    def _also(self, i: int) -> list[tuple[MisfitGroup, float]]:
        others = np.flatnonzero(self.material[i] & (np.arange(len(GROUPS)) != self.cause[i]))
        return [(GROUPS[k], float(self.measured.px[i, k])) for k in others]

    def effect_text(self, i: int) -> str:
        """Effect and q of the cause, and the other material groups."""
        others = ", ".join(f"{group} {px:.2f} px" for group, px in self._also(i))
        return f"{self.px[i]:.2f} px, q = {self.q[i]:.2g}" + (f" (also {others})" if others else "")


def decide_misfits(measured: MeasuredMisfit, *, alpha: float, tau_px: FloatArray) -> MisfitDecisions:
    """Name the cause among the material groups, among the significant ones where none is material."""
    significant = measured.q < alpha
    material: BoolArray = significant & (measured.px > tau_px[:, None])
    candidates = np.where(material.any(axis=1, keepdims=True), material, significant)
    cause = named_causes(measured, candidates)
    named = cause >= 0
    rows = np.arange(len(cause))
    px, q = (np.where(named, each[rows, cause], math.nan) for each in (measured.px, measured.q))
    worth = np.where(named[:, None], measured.worth[rows, cause], math.nan)
    return MisfitDecisions(measured, cause, px, q, tau_px, material & named[:, None], worth)


def decide_each(
    tested: Sequence[Mapping[MisfitGroup, GroupDiagnostics]], *, alpha: float, tau_px: FloatArray
) -> list[MisfitDecision]:
    """Return the same of n images or cameras, one record each; tau_px (n,)."""
    measured = MeasuredMisfit.of([MisfitDiagnostics(groups, 0, math.nan) for groups in tested])
    decided = decide_misfits(measured, alpha=alpha, tau_px=tau_px)
    return [record for i in range(len(tested)) if (record := decided.record(i)) is not None]


def named_causes(measured: MeasuredMisfit, candidates: BoolArray) -> IntArray:
    """Return the candidate (n, 6) whose parameters pay most (BIC), (n,) places in GROUPS, -1 without candidates.

    A significant group is not yet the cause: a missing k2 also makes rolling_shutter significant. Tangential and
    principal_point span nearly the same fields; either is named, and they count as one answer.
    """
    tested = candidates & (measured.status == STATUS_CODES[MisfitStatus.TESTED])
    best = np.argmax(np.where(tested, measured.gain, -math.inf), axis=1)
    rows = np.arange(len(best))
    best = np.where(tested[rows, best], best, np.argmax(tested, axis=1))  # all of them gain nothing at all
    return np.where(tested[rows, best], best, -1)


def named_cause(
    groups: Mapping[MisfitGroup, GroupDiagnostics], candidates: Collection[MisfitGroup]
) -> MisfitGroup | None:
    """Return the same of one image or camera, None without candidates."""
    measured = MeasuredMisfit.of([MisfitDiagnostics(groups, 0, math.nan)])
    cause = int(named_causes(measured, np.array([[group in candidates for group in GROUPS]]))[0])
    return GROUPS[cause] if cause >= 0 else None


def are_worth_nothing(cause: IntArray, worth: FloatArray) -> BoolArray:
    """Whether admitting a misfit would change nothing that anybody uses: such an image is accepted with a remark.

    Unknown worth counts as enough.

    Parameters
    ----------
    cause : (n,) places in GROUPS        worth : (n, 3) degrees, share of the depth, share of f
    """
    deg, centre, focal = worth.T
    focal = np.where(np.isnan(focal), 0.0, np.abs(focal))
    shift = (centre < MIN_SHIFT_WORTH_CENTRE) & (focal < MIN_SHIFT_WORTH_FOCAL_REL)
    other = (deg < WEAK_WORTH_DEG) & (focal < WEAK_WORTH_FOCAL_REL)
    return np.asarray(~np.isnan(deg) & np.where(_IS_SHIFT[cause], shift, other))


def is_worth_nothing(group: MisfitGroup, worth: Worth | None) -> bool:
    """Return the same of one misfit; None is not known."""
    if worth is None:
        return False
    numbers = np.array([[worth.rotation_deg, worth.centre_rel, worth.focal_rel]])
    return bool(are_worth_nothing(np.array([GROUPS.index(group)]), numbers)[0])


def judge_misfit(measured: Measured, found: MisfitDecisions, settings: AuditConfig) -> Judged:
    """Rejected where a group is material, undetermined where no lens group could be tested.

    Groups that the camera model already has are null and say nothing; that one of the others could not be tested is a
    remark.
    """
    misfit, member, num = measured.misfit, Member.MISFIT, measured.num_inliers
    _, said = too_few(member, "inliers", num, ~misfit.known, settings)
    unknown, of_unknown = exact_or_few(member, measured, misfit.known, settings)
    open_ = misfit.known & ~unknown
    too_few_tested, of_tested = _too_few_tested(measured, open_, settings)
    open_ &= ~too_few_tested
    shared = np.zeros(len(num), dtype=bool)
    shared[list(misfit.shared)] = True
    material = open_ & found.material.any(axis=1)
    small = (found.largest_px <= MAX_WORTHLESS_TAUS * found.tau_px) & ~shared
    worthless = material & small & are_worth_nothing(found.cause, found.worth)
    rejected = material & ~worthless
    no_lens = ~((misfit.status == STATUS_CODES[MisfitStatus.TESTED]) & _IS_LENS).any(axis=1)
    untested = open_ & found.untested.any(axis=1)
    said += [
        *of_unknown,
        *of_tested,
        *_worthless(found, worthless),
        *_shared(found, rejected & shared),
        *_causes(found, rejected),
        _not_tested(misfit.status, untested),
        say(
            open_ & ~material & no_lens & ~untested,
            About(ReasonCode.MISFIT_NOT_TESTED, member),
            lambda _: "no group left",
        ),
    ]
    cases = {Verdict.REJECTED: rejected, Verdict.UNDETERMINED: ~open_ | (no_lens & ~material)}
    return Judged.of(cases, Verdict.ACCEPTED, said)


def _too_few_tested(measured: Measured, asked: BoolArray, settings: AuditConfig) -> tuple[BoolArray, list[Said]]:
    """Where the joint test used too few of the inliers."""
    num, tested, needed = measured.num_inliers, measured.misfit.num_tested, settings.min_observations
    few = asked & (tested < needed)
    about = About(ReasonCode.TOO_FEW_OBSERVATIONS, Member.MISFIT, "count")
    return few, [say(few, about, lambda i: f"{tested[i]} of {num[i]} inliers tested, {needed} needed", tested, needed)]


def _worthless(found: MisfitDecisions, holds: BoolArray) -> list[Said]:
    def text(i: int) -> str:
        deg, centre, focal = found.worth[i]
        said = "" if math.isnan(focal) else f", {focal:+.2g} of f"
        return (
            f"{GROUPS[found.cause[i]]} {found.px[i]:.2f} px, worth {deg:.2g} degrees, {centre:.2g} of the depth{said}"
        )

    return [
        say(
            holds & (found.cause == k),
            About(ReasonCode.MISFIT_WITHOUT_WORTH, Member.MISFIT, "px", group),
            text,
            found.px,
            found.tau_px,
        )
        for k, group in enumerate(GROUPS)
    ]


def _shared(found: MisfitDecisions, holds: BoolArray) -> list[Said]:
    """The camera as a whole, beside the group of the image."""
    out = []
    for group in GROUPS:
        of = {i: each for i, each in found.measured.shared.items() if holds[i] and each.group is group}
        px: FloatArray = np.full(len(holds), math.nan)
        px[list(of)] = [each.px for each in of.values()]
        about = About(ReasonCode.SHARED_CAMERA, Member.MISFIT, "px", group)
        own = np.zeros(len(holds), dtype=bool)
        own[list(of)] = True
        out.append(say(own, about, lambda i, of=of: of[i].text, px, found.tau_px))  # type: ignore[misc]
    return out


def _causes(found: MisfitDecisions, rejected: BoolArray) -> list[Said]:
    return [
        say(
            rejected & (found.cause == k),
            About(MISFIT_CODES[group], Member.MISFIT, "px", group),
            found.effect_text,
            found.px,
            found.tau_px,
        )
        for k, group in enumerate(GROUPS)
    ]


def _not_tested(status: IntArray, holds: BoolArray) -> Said:
    """Which groups were not tested and why; all at once where they have one reason."""

    def text(i: int) -> str:
        untested = [(group, STATUSES[code]) for group, code in zip(GROUPS, status[i], strict=True) if _IS_NO_TEST[code]]
        if len(untested) == len(GROUPS) and len({why for _, why in untested}) == 1:
            return f"all groups ({untested[0][1]})"
        return ", ".join(f"{group} ({why})" for group, why in untested)

    about = About(ReasonCode.MISFIT_NOT_TESTED, Member.MISFIT)
    return say(holds, about, text, depends_on=list(status.T))
