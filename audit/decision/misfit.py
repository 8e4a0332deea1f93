"""Is an image's camera wrong enough to say so, in which way, and what would fix it? (method.md sections 5 and 7)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sfm_audit.audit.decision.verdict import Judgement, Reason, ReasonCode, Verdict
from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, MisfitTests, named_cause
from sfm_audit.loaders.arrays import FloatArray

LENS_GROUPS = (MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE, MisfitGroup.PRINCIPAL_POINT)
_CODES = {group: ReasonCode(f"misfit_{group}") for group in GROUPS}
_WHY_NOT = {
    MisfitStatus.NOT_ENOUGH_EVIDENCE: "not enough evidence",
    MisfitStatus.SINGULAR: "scores singular",
    MisfitStatus.NOT_FINITE: "derivatives not finite",
    MisfitStatus.NO_FIELDS: "spherical camera",
}


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """What is wrong with a camera: the named cause, and what is material.

    tests: the tests it rests on.          q: per group, adjusted over groups and over images (or cameras).
    group: the cause, None where no group is significant.        px, of_q: the cause's effect and q, else NaN.
    material: significant groups with an effect above tau.
    """

    tests: MisfitTests
    q: Mapping[MisfitGroup, float]
    group: MisfitGroup | None
    px: float
    of_q: float
    material: tuple[MisfitGroup, ...]


def find_misfit(
    tests: MisfitTests, q: FloatArray, *, num_observations: int, sigma_px: float, alpha: float, tau_px: float
) -> Misfit:
    """Name the cause among the significant groups; q is (6,) in the order of GROUPS, NaN where not tested."""
    by_group = dict(zip(GROUPS, (float(value) for value in q), strict=True))
    significant = [group for group in GROUPS if by_group[group] < alpha]
    material = tuple(group for group in significant if tests[group].px > tau_px)
    cause = named_cause(tests, material or significant, num_observations, sigma_px)
    if cause is None:
        return Misfit(tests, by_group, None, math.nan, math.nan, ())
    return Misfit(tests, by_group, cause, tests[cause].px, by_group[cause], material)


def judge_misfit(misfit: Misfit) -> Judgement:
    """Judge: rejected where a group is material, undetermined where no lens group could be tested.

    Groups that the camera model already has are null and say nothing; that one of the others could not be tested is a
    remark.
    """
    untested = [
        f"{group} ({_WHY_NOT[misfit.tests[group].status]})"
        for group in GROUPS
        if misfit.tests[group].status in _WHY_NOT
    ]
    remarks = (Reason(ReasonCode.MISFIT_NOT_TESTED, ", ".join(untested)),) if untested else ()
    if misfit.group is not None and misfit.material:
        return Judgement(Verdict.REJECTED, (_reason(misfit, misfit.group), *remarks))
    if not any(misfit.tests[group].status is MisfitStatus.TESTED for group in LENS_GROUPS):
        return Judgement(Verdict.UNDETERMINED, remarks or (Reason(ReasonCode.MISFIT_NOT_TESTED, "no group left"),))
    return Judgement(Verdict.ACCEPTED, remarks)


def shared_camera_reason(camera_id: int, num_images: int, pooled: Misfit) -> Reason:
    """Say that the camera as a whole is at fault; ``pooled`` is material."""
    detail = f"camera {camera_id}, {num_images} images: {pooled.group} {pooled.px:.2f} px, q = {pooled.of_q:.2g}"
    return Reason(ReasonCode.SHARED_CAMERA, detail)


def _reason(misfit: Misfit, cause: MisfitGroup) -> Reason:
    others = [f"{group} {misfit.tests[group].px:.2f} px" for group in misfit.material if group != cause]
    detail = f"{misfit.px:.2f} px, q = {misfit.of_q:.2g}" + (f" (also {', '.join(others)})" if others else "")
    return Reason(_CODES[cause], detail)
