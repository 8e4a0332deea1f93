"""docs/realtruth.md: tables of rates, and the sentences that say how far they carry."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Final

import pandas as pd

from scripts.realtruth.bench import healthy, neighbours, planted
from scripts.realtruth.rates import (
    FALSE_COLUMNS,
    FEWER_IS_WORSE,
    PREDICTORS,
    Rate,
    accepted,
    detections,
    false_rejections,
    focal_statements,
    implied_principal_points,
    predictions,
    undetermined,
)
from scripts.realtruth.worth import on_public_models, on_truth

INTRO: Final = """\
Photos with cameras that somebody measured by other means (lidar for *fountain* and *entry*, Strecha et al. 2008;
GPS/IMU and calibration for *kitti2*, a KITTI sequence; a gantry for *temple*, Middlebury), reconstructed for this
project with COLMAP: triangulated from the true poses, then adjusted twice. *fountaind* is *fountain*, blurred, with
noise and strong compression. In some models the keypoints of a quarter of the images were moved by a known field
before adjustment (*planted*: a missing k2, tangential distortion, rotation during read-out, a random smooth field),
so that the residuals stay real ones; in two models all principal points were put 8 px off (*absorbed*). The photos,
the models and numbers of single photos are no part of this repository."""
READING: Final = """\
Every cell: how many of how many, and Wilson's 95 % interval of the share, which takes images for independent. They are
not quite: images of one model share points, and *fountain*, *fountaind* show one scene."""
BEFORE: Final = """\
Version 0.1.0 (commit fbf7037, policy `full`) rejected 105 of the 198 healthy images (27 by misfit, 86 by KS), found 25
of 29 planted fields of 0.5 px and more, and said of 3 of 106 focal lengths that were wrong by more than 1 % that they
are not known; of own parameters and implied ones it said nothing."""
FALSE_INTRO: Final = """\
Images that are right and are rejected, by the verdict and by the policy (`under_...`). `standard` is the default."""
PLANTED_INTRO: Final = """\
*Found*: `verdict_misfit`, `verdict_camera` or `verdict_pose` rejects. px: RMS of the planted field that the image's
own pose and intrinsics do not take up; of moved poses `pose_offset_px`. *Cause*: `misfit_group` of the images that
misfit rejects (tangential and principal point count as one answer, and affine as an answer to rotation during
read-out)."""
FOCAL_INTRO: Final = """\
Healthy and planted images whose focal length is wrong, and healthy ones whose focal length is right, by the true
calibration. The truth of KITTI's focal length is itself disputed at 1 to 2 %: its photos calibrate themselves to 704
to 706 px instead of 719."""
SPREAD_INTRO: Final = """\
Error of the focal length over its joint standard deviation, healthy images, median by scene (0.67 is what a standard
deviation that holds would give):"""
PREDICT_INTRO: Final = """\
Rank correlation with the true error of the camera (`gt_px`: median distance between projections by the model's camera
and by the true one), over all images and as the median within a model; area under the curve (AUC) for a focal length
that is wrong by more than 1 % (with and without kitti2), and for planted images (0.5 px and more) among their
neighbours. AUC 0.5 says nothing. Of inliers, track length and coverage the negative number, so that a larger value
always speaks against an image."""
PREDICT_SAYS: Final = """\
The mean reprojection error says little of the true error: a camera can be wrong by tens of pixels where the residuals
are small. Whether a focal length is wrong is said by its joint deviation; the conditional one says it in one of the two
columns and the opposite in the other. Which image has the wrong lens is said by `misfit_px`. Nothing orders the images
*within* a model well. That few inliers or low coverage go with wrong focal lengths once kitti2 is left out is the one
scene *temple*: small photos of a small object."""
RULE_INTRO: Final = """\
A misfit can be there without mattering. Rules for `verdict_misfit`, each with the other verdicts as they are (moved
poses, which are not misfit's, left out): the least effect in px, and what it must be worth. Worth: by how much
admitting the named group would turn the image (`misfit_worth_deg`), move its centre (`misfit_worth_centre`, in
median depths) or change its focal length (`misfit_worth_focal_rel`). Public: the models of [corpus.md](corpus.md),
whose truth nobody knows, so a share there is no error rate."""
RULE_SAYS: Final = """\
Degrees alone do not tell what matters: a turn takes up a shift of the principal point (8 px at f = 3000 px are 0.15
degrees, and the same rays). So they do not count for shifts: principal_point and its twin, tangential. The rule in bold
is the audit's: such an image is accepted with the remark `misfit_without_worth`. It keeps what the first one finds from
half a pixel on; a stricter one would accept few public images more: what is there is mostly real and large."""
REMAINS: Final = """\
- **These numbers are small.** {num_healthy} healthy images of {num_scenes} photo sets, {num_planted} planted ones; from
  three sources. A rate of 0 of {num_healthy} does not exclude {upper:.1%}. Thresholds were chosen with these
  models in sight.
- **What was adjusted around is not seen.** A camera that is wrong in the same way in all images, with points and poses
  adjusted around it, keeps hundredths of a pixel of residual: all {num_absorbed} images of the absorbed models are
  accepted although they are wrong by {absorbed_px:.0f} px. What is said is the finding `implied_principal_point`.
  Nothing inside a model sees its scale, its drift, or two places taken for one.
- **Standard deviations are too small** in {num_low} of {num_scenes} scenes, by {low:.1f} to {high:.1f} times (medians
  above over 0.67): real errors are correlated and systematic. Read a focal length as known to about five of its
  standard deviations.
- **Small defects are missed.** Planted fields below 0.5 px are found in {small}.
- **Sound images beside bad ones** are rejected by `standard` in {beside}: a planted field reaches them through the
  points, and a moved pose makes the noise of its neighbours look strange (`verdict_noise`)."""


_MEDIAN_OF_NORMAL: Final = 0.6745


def document(images: pd.DataFrame, public: pd.DataFrame | None) -> str:
    """Return the page; ``public``: images of models without truth, None where there are none."""
    parts = [
        "# What the audit says where the truth is known",
        "Made by `scripts/real_truth.py --write`; do not edit.",
        f"{images.model.nunique()} reconstructions, {len(images)} images. " + _flat(INTRO),
        READING,
        BEFORE,
        *_false_rejections(images),
        *_detections(images),
        *_focal(images),
        *_absorbed(images),
        *_predictions(images),
        *_rules(images, public),
        "## What remains",
        _remains(images),
    ]
    return "\n\n".join(_filled(part) for part in parts) + "\n"


def _flat(text: str) -> str:
    return " ".join(text.split())


def _filled(part: str) -> str:
    """Fill paragraphs; tables, headings and lists keep their lines."""
    if part.startswith(("|", "#", "- ")):
        return part
    return textwrap.fill(_flat(part), 120, break_long_words=False, break_on_hyphens=False)


def _table(head: Sequence[str], rows: Mapping[str, Sequence[object]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    lines += ["| " + " | ".join([name, *(_cell(value) for value in row)]) + " |" for name, row in rows.items()]
    return "\n".join(lines)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.2f}"
    return value.brief if isinstance(value, Rate) else str(value)


def _of_rates(rows: Mapping[str, Mapping[str, Rate]], first: str) -> str:
    head = [first, *next(iter(rows.values()))]
    return _table(head, {name: list(row.values()) for name, row in rows.items()})


def _false_rejections(images: pd.DataFrame) -> list[str]:
    rows = false_rejections(images)
    columns = [f"`{column.removeprefix('under_')}`" if "under_" in column else column for column in FALSE_COLUMNS]
    table = _table(["scene", *columns], {name: list(row.values()) for name, row in rows.items()})
    said = {name: [found] for name, found in undetermined(images).items()}
    return [
        "## Sound images rejected",
        FALSE_INTRO,
        table,
        "Healthy images of which `standard` says *undetermined*, mostly since the focal length is not known to 0.5 %:",
        _table(["scene", "undetermined"], said),
    ]


def _detections(images: pd.DataFrame) -> list[str]:
    return ["## Planted defects", PLANTED_INTRO, _of_rates(detections(images), "kind")]


def spreads(images: pd.DataFrame) -> dict[str, float]:
    """Return by scene the median of |f error| over its joint sd, healthy images with a focal length that was fitted."""
    known = healthy(images)
    known = known[(known.sd_focal_rel_joint > 0) & (known.focal_rel != 0)]
    ratio = known.focal_rel.abs() / known.sd_focal_rel_joint.astype(float)
    return {str(scene): float(part.median()) for scene, part in ratio.groupby(known.bench_scene)}


def _focal(images: pd.DataFrame) -> list[str]:
    rows = {name: [found] for name, found in focal_statements(images).items()}
    return [
        "## Focal lengths",
        FOCAL_INTRO,
        _table(["images", "accepted by `standard`"], rows),
        SPREAD_INTRO,
        _table(["scene", "median abs(f error) / sd"], {scene: [ratio] for scene, ratio in spreads(images).items()}),
    ]


def _absorbed(images: pd.DataFrame) -> list[str]:
    found, wrong = implied_principal_points(images)
    num = healthy(images).model.nunique()
    text = (
        f"The finding `implied_principal_point` is in {sum(found.values())} of {len(found)} models whose principal "
        f"points are 8 px off in all images, and in {len(wrong)} of {num} healthy models. Their images are accepted: "
        f"{accepted(images[images.label == 'absorbed'])}."
    )
    return ["## A principal point that is wrong everywhere", text]


def _predictions(images: pd.DataFrame) -> list[str]:
    head = ["column", "with gt_px", "within models", "f over 1 %", "without kitti2", "planted"]
    found = predictions(images)
    rows = {f"`{column}`" + ", negative" * (column in FEWER_IS_WORSE): list(found[column]) for column in PREDICTORS}
    return ["## What predicts the true error, and what does not", PREDICT_INTRO, _table(head, rows), PREDICT_SAYS]


def _rules(images: pd.DataFrame, public: pd.DataFrame | None) -> list[str]:
    rows = on_truth(images)
    if public is not None:
        rows = {name: row | on_public_models(public)[name] for name, row in rows.items()}
    return ["## What should `standard` reject?", RULE_INTRO, _of_rates(rows, "rule"), RULE_SAYS]


def _remains(images: pd.DataFrame) -> str:
    sound = healthy(images)
    ratios = [ratio / _MEDIAN_OF_NORMAL for ratio in spreads(images).values()]
    low = [ratio for ratio in ratios if ratio > 1.0]
    absorbed = images[images.label == "absorbed"]
    beside = neighbours(images)
    numbers = {
        "num_healthy": len(sound),
        "num_scenes": sound.bench_scene.nunique(),
        "num_planted": len(planted(images)),
        "upper": 3.0 / max(len(sound), 1),
        "num_absorbed": len(absorbed),
        "absorbed_px": absorbed.gt_px.median(),
        "num_low": len(low),
        "low": min(low, default=math.nan),
        "high": max(low, default=math.nan),
        "small": detections(images)["all"]["under 0.5 px"],
        "beside": false_rejections(images)["neighbours of planted"]["under_standard"] if len(beside) else "-",
    }
    lines = [line if line.startswith("- ") else line.strip() for line in REMAINS.format_map(numbers).splitlines()]
    items = [" ".join(item.split()) for item in "\n".join(lines).split("\n- ")]
    return "\n".join(
        textwrap.fill(item if item.startswith("- ") else f"- {item}", 120, subsequent_indent="  ") for item in items
    )
