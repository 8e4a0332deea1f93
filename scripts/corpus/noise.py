"""Noise models on a corpus: how often tests of normality reject, model by model, and medians over models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd

from scripts.corpus.models import CorpusModel
from sfm_audit.audit.table.words import Verdict

MIN_INLIERS: Final = 50  # in the median image
LEVEL: Final = 0.05
BANDS: Final = {"ks constant": (0.9, 1.0), "ks track": (0.0, 0.45), "kurt track": (-0.35, 0.35)}
"""Of the medians over the models of corpus_report.py --quick."""
INTRO: Final = """\
For every model with at least {least} inliers in its median image: share of images that a test rejects at 5 %, and the
median excess kurtosis of an image's standardised residuals, under two noise models (images whose points are exact
projections are left out; medians count a model once that is there as binary and as text; `images`: sum). *constant*:
one robust sigma for the raw residuals. *track*: noise predicted from the rest of each track ([method.md](method.md),
section 3). nu0, s0: the fitted spread and scale of the noise of tracks; removable: share of the squared residuals that
moving the 3D points alone would remove (0: the points are at their optimum)."""


def noise_rows(models: Sequence[CorpusModel]) -> pd.DataFrame:
    """Return one row per model that has enough inliers."""
    rows = {}
    for model in models:
        images = model.images[model.images.verdict_ks != Verdict.UNDETERMINED]
        if not len(images) or images.num_inliers.median() < MIN_INLIERS:
            continue
        rows[model.name] = {
            "images": len(images),
            "inliers": images.num_inliers.median(),
            "ks constant": _share(images.ks_constant_p),
            "ks track": _share(images.ks_p),
            "ks_fitted track": _share(images.ks_fitted_p),
            "dap track": _share(images.dap_p),
            "kurt constant": images.kurtosis_constant.median(),
            "kurt track": images.kurtosis_excess.median(),
            "nu0": model.model["noise_nu0"],
            "s0 px": model.model["noise_s0_px"],
            "removable": model.model["removable_share"],
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def noise_part(models: Sequence[CorpusModel]) -> list[str]:
    """Return the section's lines."""
    rows = noise_rows(models)
    out = ["## Noise models on real data", "", INTRO.format(least=MIN_INLIERS), ""]
    out += ["| model | " + " | ".join(rows.columns) + " |", "|---|" + "---:|" * len(rows.columns)]
    distinct = rows.round(6).drop_duplicates()
    datasets = pd.Series({model.name: model.dataset for model in models})[distinct.index]
    groups = [(f"**median of {dataset} ({len(part)})**", part) for dataset, part in distinct.groupby(datasets)]
    groups += [(f"**median of all {len(distinct)}**", distinct)] if len(groups) > 1 else []
    medians = [(name, part.median().to_dict() | {"images": part["images"].sum()}) for name, part in groups]
    for name, row in [*rows.to_dict("index").items(), *medians]:
        out.append(f"| {name} | " + " | ".join(_cell(column, row[column]) for column in rows.columns) + " |")
    return out


def check_bands(models: Sequence[CorpusModel]) -> list[str]:
    """Return the medians that leave their bands, in words."""
    rows = noise_rows(models)
    medians = rows.median()
    print(rows.to_string(float_format="%.2f"))
    return [
        f"median of {column} is {medians[column]:.3f}, not in {low} .. {high}"
        for column, (low, high) in BANDS.items()
        if not low <= medians[column] <= high
    ]


def _share(p: pd.Series) -> float:
    known = p.dropna()
    return float((known < LEVEL).mean()) if len(known) else float("nan")


def _cell(column: str, value: float) -> str:
    if not np.isfinite(value):
        return "-"
    if column in {"images", "inliers"}:
        return f"{value:.0f}"
    if column == "removable":
        return f"{value:.1%}"
    if column.startswith(("ks", "dap")):
        return f"{value:.0%}"
    return f"{value:.3g}" if column == "nu0" else f"{value:.2f}"
