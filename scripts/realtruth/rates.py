"""How often the audit is right on images with ground truth: rates with Wilson intervals, per scene and kind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from scripts.realtruth.bench import CAUSES, healthy, hit, neighbours, planted, rejected
from sfm_audit.audit.table.words import POLICIES, Verdict

VISIBLE_PX: Final = 0.5  # a planted field of this size can be seen by eye
BAD_FOCAL: Final = 0.01
GOOD_FOCAL: Final = 0.005
_Z: Final = 1.959964  # 97.5 % point of the normal


@dataclass(frozen=True, slots=True)
class Rate:
    """``num`` of ``of``; NaN of nothing."""

    num: int
    of: int

    @property
    def share(self) -> float:
        """The rate itself."""
        return self.num / self.of if self.of else math.nan

    def __str__(self) -> str:
        if not self.of:
            return "-"
        low, high = wilson(self.num, self.of)
        return f"{self.num} of {self.of} = {self.share:.1%} ({low:.1%} .. {high:.1%})"

    @property
    def brief(self) -> str:
        """The same for a cell of a table."""
        if not self.of:
            return "-"
        low, high = wilson(self.num, self.of)
        return f"{self.num}/{self.of}, {100 * low:.0f}–{100 * high:.0f} %"


def rate(mask: pd.Series) -> Rate:
    """Return how many of a mask are true."""
    return Rate(int(mask.sum()), len(mask))


def wilson(num: int, of: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a rate (Wilson 1927), which stays inside 0 .. 1 at small counts.

    It takes images for independent; those of one model are not quite.
    """
    if not 0 <= num <= of or of == 0:
        raise ValueError(f"{num} of {of} is no rate")
    p, z2 = num / of, _Z**2
    centre = (p + z2 / (2 * of)) / (1 + z2 / of)
    half = _Z / (1 + z2 / of) * math.sqrt(p * (1 - p) / of + z2 / (4 * of**2))
    return max(0.0, centre - half), min(1.0, centre + half)


FALSE_COLUMNS: Final = (
    *("verdict_misfit", "verdict_camera", "verdict_pose", "plausible", "verdict_noise"),
    *(f"under_{policy}" for policy in POLICIES),
)


def false_rejections(images: pd.DataFrame) -> dict[str, dict[str, Rate]]:
    """Per scene, then of all, then of neighbours: rejections of sound images by member and policy."""
    sound = healthy(images)
    rows = {str(scene): part for scene, part in sound.groupby("bench_scene")}
    rows |= {"all healthy": sound, "neighbours of planted": neighbours(images)}
    return {name: {column: rate(rejected(part, column)) for column in FALSE_COLUMNS} for name, part in rows.items()}


def undetermined(images: pd.DataFrame) -> dict[str, Rate]:
    """Per scene: healthy images of which `standard` says nothing."""
    sound = healthy(images)
    said = sound.under_standard == Verdict.UNDETERMINED
    return {str(scene): rate(part) for scene, part in said.groupby(sound.bench_scene)} | {"all healthy": rate(said)}


def detections(images: pd.DataFrame) -> dict[str, dict[str, Rate]]:
    """Per kind: planted images found, below and from half a pixel on, and the cause named right."""
    known = planted(images)
    rows = {str(kind): part for kind, part in known.groupby("kind")} | {"all": known}
    return {name: _detection(part) for name, part in rows.items()}


def _detection(part: pd.DataFrame) -> dict[str, Rate]:
    large = part.planted_px >= VISIBLE_PX
    named = part[rejected(part, "verdict_misfit") & part.kind.isin(list(CAUSES))]
    right = pd.Series(
        [group in CAUSES[kind] for kind, group in zip(named.kind, named.misfit_group, strict=True)], dtype=bool
    )
    return {
        "under 0.5 px": rate(hit(part)[~large]),
        "0.5 px and more": rate(hit(part)[large]),
        "cause right": rate(right),
    }


def focal_statements(images: pd.DataFrame) -> dict[str, Rate]:
    """What `standard` accepts of wrong focal lengths, and of right ones."""
    known = images[images.focal_rel.notna() & images.label.isin(["healthy", "defective"])]
    bad = known[known.focal_rel.abs() > BAD_FOCAL]
    good = healthy(images)
    good = good[good.focal_rel.abs() < GOOD_FOCAL]
    return {
        "wrong by more than 1 %, accepted": accepted(bad),
        "the same without kitti2": accepted(bad[bad.bench_scene != "kitti2"]),
        "healthy, within 0.5 %, accepted": accepted(good),
        "the same without temple": accepted(good[good.bench_scene != "temple"]),
    }


def accepted(images: pd.DataFrame) -> Rate:
    """Return how many `standard` accepts."""
    return rate(images.under_standard == Verdict.ACCEPTED)


def implied_principal_points(images: pd.DataFrame) -> tuple[dict[str, bool], list[str]]:
    """Of each absorbed model: whether implied_principal_point is found; the healthy models that have it."""
    found = {
        str(name): "implied_principal_point" in part.findings.iloc[0]
        for name, part in images.groupby("model")
        if (part.label == "absorbed").any()
    }
    wrong = [
        str(name)
        for name, part in healthy(images).groupby("model")
        if "implied_principal_point" in part.findings.iloc[0]
    ]
    return found, wrong


def spearman(first: pd.Series, second: pd.Series) -> float:
    """Return the rank correlation of what is known of both; NaN below four values or without spread."""
    both = pd.concat([first, second], axis=1).astype(float).dropna()
    if len(both) < 4 or (both.nunique() < 2).any():
        return math.nan
    return float(np.corrcoef(both.rank().to_numpy().T)[0, 1])


def auc(values: pd.Series, positive: pd.Series) -> float:
    """Return the chance that a positive has the larger value, ties half; NaN without both kinds."""
    known = values.astype(float).notna()
    ranks, yes = values[known].astype(float).rank(), positive[known].astype(bool)
    num, others = int(yes.sum()), int((~yes).sum())
    if not num or not others:
        return math.nan
    return float((ranks[yes].sum() - num * (num + 1) / 2) / (num * others))


FEWER_IS_WORSE: Final = ("num_inliers", "mean_track_length", "coverage")
PREDICTORS: Final = (
    "mean_px",
    *FEWER_IS_WORSE,
    *("sd_focal_rel_conditional", "sd_focal_rel_joint", "expected_error_px", "misfit_px", "own_step_px"),
)


def predictions(images: pd.DataFrame) -> dict[str, Sequence[float]]:
    """Per column: Spearman's correlation with gt_px, all and median within models; AUCs.

    AUC: wrong focal length (over 1 %, with and without kitti2), planted images (0.5 px and more) among their
    neighbours. FEWER_IS_WORSE: of the negative number, so that a larger value always speaks against an image.
    """
    images = images.assign(**{column: -images[column].astype(float) for column in FEWER_IS_WORSE})
    known = images[images.gt_px.notna()]
    focal = known.focal_rel.abs()
    elsewhere = known.bench_scene != "kitti2"
    pool = pd.concat([planted(images)[planted(images).planted_px >= VISIBLE_PX], neighbours(images)])
    pool = pool[pool.kind != "pose"]
    return {
        column: (
            spearman(known[column], known.gt_px),
            _within(known, column, "gt_px"),
            auc(known[column], focal > BAD_FOCAL),
            auc(known[column][elsewhere], focal[elsewhere] > BAD_FOCAL),
            auc(pool[column], pool.label == "defective"),
        )
        for column in PREDICTORS
    }


def _within(images: pd.DataFrame, column: str, error: str) -> float:
    each = [spearman(part[column], part[error]) for _, part in images.groupby("model")]
    return float(pd.Series(each).median())
