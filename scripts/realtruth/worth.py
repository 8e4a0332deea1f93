"""What should `standard` reject? Rules for a misfit, side by side on ground truth and on public models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import pandas as pd

from scripts.realtruth.bench import healthy, neighbours, planted, rejected
from scripts.realtruth.rates import VISIBLE_PX, Rate, rate
from sfm_audit.audit.decision.diagnostics import Worth
from sfm_audit.audit.decision.misfit import is_worth_nothing
from sfm_audit.audit.table.thresholds import (
    ALPHA,
    MAX_WORTHLESS_TAUS,
    MIN_EFFECT,
    MIN_SHIFT_WORTH_CENTRE,
    MIN_SHIFT_WORTH_FOCAL_REL,
    WEAK_WORTH_DEG,
    WEAK_WORTH_FOCAL_REL,
    effect_px,
)
from sfm_audit.audit.table.words import GROUPS, POLICIES, Member, MisfitGroup

_OTHERS: Final = [member.value for member in POLICIES["standard"] if member not in {Member.MISFIT, Member.OUTSIDE}]


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule for a misfit: its words, and the images (a mask) that it rejects."""

    words: str
    rejects: Callable[[pd.DataFrame], pd.Series]


def above(tau_px: float) -> Callable[[pd.DataFrame], pd.Series]:
    """Return the rule: a significant group has an effect above tau."""

    def rejects(images: pd.DataFrame) -> pd.Series:
        found = pd.Series(data=False, index=images.index)
        for group in GROUPS:
            px, q = images[f"misfit_{group}_px_joint"].astype(float), images[f"misfit_{group}_q_joint"].astype(float)
            found |= (px > tau_px) & (q < ALPHA.default)
        return found & images.misfit_group.notna()

    return rejects


@dataclass(frozen=True, slots=True)
class Least:
    """What a misfit must be worth: degrees, share of the median depth, share of f; one of them is enough.

    free: groups whose degrees do not count.
    """

    rotation_deg: float
    centre_rel: float
    focal_rel: float
    free: frozenset[MisfitGroup] = frozenset()

    def rejects(self, images: pd.DataFrame) -> pd.Series:
        """Return the images above tau whose named group is worth that much; unknown worth counts as enough."""
        turn, centre = images.misfit_worth_deg.astype(float), images.misfit_worth_centre.astype(float)
        focal = images.misfit_worth_focal_rel.astype(float).abs()
        turned = (turn >= self.rotation_deg) & ~images.misfit_group.isin(self.free)
        enough = turned | (centre >= self.centre_rel) | (focal >= self.focal_rel) | turn.isna()
        return above(TAU_PX)(images) & enough


def as_decided(images: pd.DataFrame) -> pd.Series:
    """Return the rule of the audit (`is_worth_nothing`), on the columns of the table."""
    worths = zip(
        images.misfit_group,
        images.misfit_worth_deg.astype(float),
        images.misfit_worth_centre.astype(float),
        images.misfit_worth_focal_rel.astype(float),
        strict=True,
    )
    nothing = [
        isinstance(group, str) and is_worth_nothing(MisfitGroup(group), Worth(*worth)) for group, *worth in worths
    ]
    small = images.misfit_px.astype(float) <= MAX_WORTHLESS_TAUS * TAU_PX
    return above(TAU_PX)(images) & ~(small & pd.Series(nothing, index=images.index, dtype=bool))


TAU_PX: Final = effect_px(MIN_EFFECT, None) or 0.2
SHIFTS: Final = frozenset({MisfitGroup.PRINCIPAL_POINT, MisfitGroup.TANGENTIAL})
"""A turn of the image takes them up: 8 px of the principal point at f = 3000 px are 0.15 degrees, and the same rays."""
_DECIDED: Final = (
    f"**{TAU_PX:g} px, {WEAK_WORTH_DEG:g} deg or {WEAK_WORTH_FOCAL_REL:.1%} of f; shifts: "
    f"{MIN_SHIFT_WORTH_CENTRE:.1%} of depth or {MIN_SHIFT_WORTH_FOCAL_REL:.1%} of f**"
)
RULES: Final = (
    *(Rule(f"{tau_px:g} px", above(tau_px)) for tau_px in (TAU_PX, 0.3, 0.5)),
    Rule(
        f"{TAU_PX:g} px, {WEAK_WORTH_DEG:g} deg or {WEAK_WORTH_FOCAL_REL:.1%} of f",
        Least(WEAK_WORTH_DEG, math.inf, WEAK_WORTH_FOCAL_REL).rejects,
    ),
    Rule(_DECIDED, as_decided),
    Rule(
        f"{TAU_PX:g} px, 0.05 deg (not of shifts), 0.1% of depth or 0.3% of f",
        Least(0.05, 0.001, 0.003, SHIFTS).rejects,
    ),
)


def on_truth(images: pd.DataFrame) -> dict[str, dict[str, Rate]]:
    """Per rule: planted images found (by misfit, or own parameters or pose as they stand), sound ones rejected."""
    known = planted(images)
    known = known[known.kind != "pose"]
    large = known.planted_px >= VISIBLE_PX
    out = {}
    for rule in RULES:
        found = rule.rejects(known) | rejected(known, "verdict_camera", "verdict_pose")
        out[rule.words] = {
            "planted 0.5 px and more": rate(found[large]),
            "planted under 0.5 px": rate(found[~large]),
            "healthy": rate(rule.rejects(healthy(images))),
            "neighbours": rate(rule.rejects(neighbours(images))),
        }
    return out


def on_public_models(images: pd.DataFrame) -> dict[str, dict[str, Rate]]:
    """Per rule: public images that the misfit rejects, and that `standard` does."""
    others = rejected(images, *_OTHERS)
    return {
        rule.words: {
            "public: misfit": rate(rule.rejects(images)),
            "public: standard": rate(rule.rejects(images) | others),
        }
        for rule in RULES
    }
