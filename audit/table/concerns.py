"""Which findings of a model concern a given image? Read from the image's own row, never from a sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from sfm_audit.audit.table.words import Member, ReasonCode, Verdict
from sfm_audit.loaders.model import FindingCode

Row = Mapping[str, Any]

_OF_FILES: Final = frozenset(
    {
        *(FindingCode.UNSEEN_POINTS, FindingCode.SHORT_TRACKS, FindingCode.REPEATED_OBSERVATIONS),
        *(FindingCode.STORED_ERRORS_ZERO, FindingCode.STORED_ERRORS_MISSING, FindingCode.STORED_ERRORS_STALE),
        *(FindingCode.ORPHAN_CAMERAS, FindingCode.NON_FINITE_UNUSED, FindingCode.STATED_COUNT_DIFFERS),
        *(FindingCode.UNTERMINATED_TEXT, FindingCode.OBSERVATIONS_WITHOUT_IMAGE, FindingCode.DATABASE_NOT_USED),
        *(FindingCode.REFERENCE_NOT_USED, FindingCode.REFERENCE_SCALE),
        *(FindingCode.PRIORS_NOT_USED, FindingCode.PRIORS_SCALE),
    }
)
"""They say something of the files, of points or of unused records; no verdict of an image rests on them."""
_OF_SOME: Final = frozenset(
    {
        *(FindingCode.IMPLIED_PRINCIPAL_POINT, FindingCode.IMPLIED_RADIAL, FindingCode.IMPLIED_ASPECT),
        *(FindingCode.IMPLIED_TANGENTIAL, FindingCode.NON_UNIT_QUATERNIONS, FindingCode.DUPLICATE_NAMES),
        *(FindingCode.RIG_POSE_DISAGREES, FindingCode.OBSERVATIONS_OUTSIDE),
    }
)
"""They count images or observations without saying whose: an image is concerned where all are."""


def _has_reason(*codes: ReasonCode) -> Callable[[Row], bool]:
    wanted = {str(code) for code in codes}
    return lambda row: not wanted.isdisjoint(said.partition(":")[0] for said in row["reasons"] or [])


def _counts(column: str) -> Callable[[Row], bool]:
    return lambda row: (row[column] or 0) > 0


_TOLD_BY_ROW: Final[dict[FindingCode, Callable[[Row], bool]]] = {
    FindingCode.DANGLING_POINT_IDS: _counts("num_dangling"),
    FindingCode.NON_FINITE_POINTS: _counts("num_nonfinite"),
    FindingCode.NON_FINITE_OBSERVATIONS: _counts("num_nonfinite"),
    FindingCode.POINTS_BEHIND: _counts("num_behind"),
    FindingCode.CONTRADICTED_PAIRS: _counts("num_pairs_contradicting"),
    FindingCode.MISSING_CAMERAS: lambda row: row["camera_model"] is None,
    FindingCode.NON_FINITE_POSES: _has_reason(ReasonCode.NON_FINITE_POSE),
    FindingCode.NON_FINITE_CAMERAS: lambda row: not all(map(math.isfinite, row["params"] or [])),
    FindingCode.IMPLAUSIBLE_CAMERAS: lambda row: row[Member.PLAUSIBLE] == Verdict.REJECTED,
    FindingCode.IMAGES_DISAGREE: _has_reason(ReasonCode.INCONSISTENT, ReasonCode.POINTS_BEHIND),
    FindingCode.EXACT_PROJECTIONS: _has_reason(ReasonCode.EXACT_PROJECTIONS),
    FindingCode.REFERENCE_FRAGMENTS: _has_reason(ReasonCode.REFERENCE_DISAGREES),
    FindingCode.POSSIBLE_FOLD: _has_reason(ReasonCode.FOLD_DISAGREES),
}
"""Finding -> whether the row of an image has what the finding counts."""


def findings_about(row: Row, findings: Sequence[Row], num_images: int) -> list[Row]:
    """Return the findings that concern an image: those of the whole model, and those that its row shows.

    Parameters
    ----------
    row : of ``RUN/images``            findings : of its model, in ``RUN/models``            num_images : of the model
    """
    return [finding for finding in findings if _concerns(finding, row, num_images)]


def _concerns(finding: Row, row: Row, num_images: int) -> bool:
    code = finding["code"]
    if code in _OF_FILES:
        return False
    if code in _OF_SOME:
        return bool((finding["count"] or 0) == num_images)
    told = _TOLD_BY_ROW.get(code)
    return told is None or told(row)
