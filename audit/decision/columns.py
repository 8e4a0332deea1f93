"""What decisions write into the images table, in a run and when a finished run is decided again."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sfm_audit.audit.decision.decisions import MEMBERS, Decisions, Reasons, deciders
from sfm_audit.audit.decision.judged import VERDICTS
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.decision.severity import SEVERITIES
from sfm_audit.audit.table.given import Coded, Column, Listed, Structs
from sfm_audit.audit.table.words import GROUPS, PolicyName
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

CAUSE_COLUMNS: Final = ("misfit_group", "misfit_px", "misfit_q")
WORTH_COLUMNS: Final = ("misfit_px_sigma", "misfit_worth_deg", "misfit_worth_centre", "misfit_worth_focal_rel")
VERDICT_COLUMNS: Final = ("verdict", *map(str, MEMBERS), "severity", "reasons", "reason_details")
_VERDICTS: Final = (*VERDICTS, None)  # what was not asked is null
_SEVERITIES: Final = (*SEVERITIES, None)
_GROUPS: Final = (*GROUPS, None)


def cause_columns(misfit: MisfitDecision | None) -> dict[str, object]:
    """Return the named cause of one camera, its effect and q."""
    return {
        "misfit_group": str(misfit.group) if misfit and misfit.group else None,
        "misfit_px": misfit.px if misfit else math.nan,
        "misfit_q": misfit.q if misfit else math.nan,
    }


def decision_columns(decisions: Decisions, sigma_px: FloatArray) -> dict[str, Column]:
    """Return the named cause, what it is worth, verdicts, severity and reasons of n images; sigma_px (n,) of each."""
    found = decisions.misfit
    with np.errstate(invalid="ignore", divide="ignore"):
        px_sigma = np.where(sigma_px > 0, found.px / sigma_px, math.nan)
    reasons = decisions.reasons
    numbers = np.column_stack([px_sigma, found.worth]).T
    return {
        **dict(zip(CAUSE_COLUMNS, (Coded(found.cause, _GROUPS), found.px, found.q), strict=True)),
        **dict(zip(WORTH_COLUMNS, numbers, strict=True)),
        "verdict": Coded(decisions.verdict, _VERDICTS),
        **{str(member): Coded(decisions.members[member].verdict, _VERDICTS) for member in MEMBERS},
        "severity": Coded(decisions.severity, _SEVERITIES),
        "reasons": _policy_reasons(reasons, decisions.policy, decisions.pose_first),
        "reason_details": _details(reasons, len(decisions)),
    }


def _details(reasons: Reasons, num_images: int) -> Listed:
    """All reasons of each image."""
    kinds = reasons.said

    def words(name: str) -> Coded:
        return Coded(reasons.kind, [getattr(each, name) for each in kinds])

    fields: dict[str, Column] = {
        "code": words("code"),
        "verdict": words("member"),
        "value": reasons.numbers("value"),
        "limit": reasons.numbers("limit"),
        "unit": words("unit"),
        "group": words("group"),
        "text": reasons.texts,
    }
    return Listed(_offsets(reasons.row, num_images), Structs(fields))


def _policy_reasons(reasons: Reasons, policy: PolicyName, pose_first: BoolArray) -> Listed:
    """What the policy's members say, in words, each once."""
    ranks = np.full((2, len(reasons.said)), -1, dtype=np.int64)
    for first in (False, True):
        order = deciders(policy, first)
        for kind, each in enumerate(reasons.said):
            if each.member in order:
                ranks[int(first), kind] = order.index(each.member)
    rank = ranks[pose_first[reasons.row].astype(np.int64), reasons.kind]
    by_rank = np.lexsort((rank, reasons.row))  # stable: within a member they keep their order
    told = reasons.only(by_rank[rank[by_rank] >= 0])
    distinct: dict[tuple[str, str], int] = {}
    codes = [each.code for each in told.said]
    sentence = np.array(
        [
            distinct.setdefault((codes[kind], text), len(distinct))
            for kind, text in zip(told.kind.tolist(), told.texts, strict=True)
        ],
        dtype=np.int64,
    )
    _, first_place = np.unique(told.row * max(1, len(distinct)) + sentence, return_index=True)
    kept = np.sort(first_place)
    sentences = [f"{code}: {text}" for code, text in distinct]
    return Listed(_offsets(told.row[kept], len(pose_first)), Coded(sentence[kept], sentences))


def _offsets(row: IntArray, num_images: int) -> IntArray:
    """Return where the items of each image begin, of items with ascending rows, and where the last end."""
    return np.searchsorted(row, np.arange(num_images + 1))
