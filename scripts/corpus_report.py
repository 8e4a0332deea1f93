"""Audit a corpus of COLMAP models and write docs/corpus.md: noise models, verdicts, findings, explanations.

    python scripts/corpus_report.py FOLDER... [-o docs/corpus.md]     every model below the folders
    python scripts/corpus_report.py --quick [FOLDER...]               a few models against their bands, writes nothing

Without folders the corpus is looked for as the tests do: SFM_AUDIT_CORPUS, else ../shared/corpus; without a corpus
the script says so and exits with 0. Exit code 1: --quick found a median outside its band, or a written explanation
(scripts/corpus_explanations.py) is missing or no longer supported by the numbers.
"""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from tqdm import tqdm

from scripts import corpus_before
from scripts.corpus_evidence import AuditedModel, audit_for_report
from scripts.corpus_explanations import ENDED, EXPLANATIONS
from sfm_audit.audit.table.words import GROUPS, Member, Verdict
from sfm_audit.loaders import LoadError, ModelRef, discover

ROOT: Final = Path(__file__).resolve().parent.parent
MIN_INLIERS: Final = 50  # in the median image, for the table of noise models
QUICK_MODELS: Final = (
    "hsu_fox_bin",
    "halogen_sparse",
    "marychrisgo_dense",
    "softmurata",
    "yinsy_A",
    "own_south_building_sub_radial",
)
LEVEL: Final = 0.05
MOST: Final = 0.5  # of the images rejected: above it somebody has to say why
ASKED: Final = tuple(member for member in Member if member is not Member.OUTSIDE)
NOISE_INTRO: Final = """\
For every model with at least {least} inliers in its median image: share of images that a test rejects at 5 %, and the
median excess kurtosis of an image's standardised residuals, under three noise models (images whose points are exact
projections are left out; medians count a model once that is there as binary and as text; `images`: sum). *constant*:
one robust sigma for the raw residuals. *whitened*: one robust sigma for e of [method.md](method.md) (2), which undoes
what the 3D points took from the residuals. *track*: (5), noise predicted from the rest of each track. nu0, s0: the
fitted spread and scale of the noise of tracks; removable: share of the squared residuals that moving the 3D points
alone would remove (0: the points are at their optimum)."""
VERDICT_INTRO: Final = """\
Default settings: noise `track`, policy `standard`, tau 0.2 px. A/R/U: images accepted, rejected, undetermined; beside
it the same by version 0.1.0. misfit, camera, pose, plausible, noise, ks: images that this verdict rejects (an image can
be rejected by several; ks decides nothing under `standard`). Camera finding: what the pooled test says of a shared
camera (its cause, px, q, from 0.05 px on); for cameras with one image each, how often which cause
is named of images that misfit rejects. Advice: COLMAP model that holds what was found."""
EXPLAIN_INTRO: Final = """\
Written by a person, about every model of which more than half of the images is rejected. The numbers in the texts are
of this run; the script checks that they still support what is said. Words used:

- *joint*: from the joint test, what nothing else could take up, as the verdict and the table have it.
- *as it stands*: of the image alone, points as they are, which hide a third of a field. The texts' px unless said.
- *common px*: RMS length of the field that all images have in common, each image's own pose and intrinsics profiled.
  A lens that is wrong in all images shows there; motion, which differs from image to image, does not.
- *beyond rolling shutter*: the smooth field that is left when a pose that changes linearly from row to row was allowed.
- *by cells*: the same tests when all observations in a cell of 1/24 of the image's longer side count as one. Neighbours
  share errors in real models (several keypoints on one spot, points on one badly placed surface), and the tests, which
  count observations, do not know it: where *by cells* is far below *by observations*, part of the significance is that.
- *neighbours*: correlation of the residuals of points less than 1/40 of the longer side apart (same keypoint left out).
- *persistence*: correlation of a point's residuals in one image and the next one by name.
- *refitted*: bundle adjustment (pycolmap, principal points fixed) with the camera model named, audited again."""

_WORTH_NAMING_PX = 0.05  # of a pooled finding: with a million observations a thousandth of a pixel is significant


def corpus_folders(given: Sequence[Path]) -> list[Path]:
    """The folders given, or the corpus of the tests; none where there is no corpus."""
    if given:
        return list(given)
    root = Path(os.environ.get("SFM_AUDIT_CORPUS", str(ROOT.parent / "shared" / "corpus")))
    return [path for path in (root / "models", root / "megadepth_like" / "MegaDepth_v1_SfM") if path.is_dir()]


def names_of(refs: Sequence[ModelRef]) -> list[str]:
    """scene, or scene/component where a scene has several models."""
    count = Counter(ref.scene for ref in refs)
    return [ref.scene if count[ref.scene] == 1 else f"{ref.scene}/{ref.component}" for ref in refs]


def read_all(folders: Sequence[Path], *, only: Sequence[str] | None) -> tuple[list[AuditedModel], list[str]]:
    """Audit the models below the folders; the second list says in one line each what cannot be read."""
    found = discover([str(folder) for folder in folders])
    models, failures = [], [str(error) for error in found.errors]
    chosen = [
        (name, ref) for name, ref in zip(names_of(found.refs), found.refs, strict=True) if not only or name in only
    ]
    for name, ref in tqdm(chosen, disable=None):
        refit = EXPLANATIONS[name].refit if name in EXPLANATIONS and not only else ()
        try:
            models.append(audit_for_report(name, ref, refit=refit))
        except LoadError as error:
            failures.append(f"{name}: {str(error).replace(ref.location, '').lstrip('/: ')}")
    return models, failures


def share(p: pd.Series) -> float:
    """Share of the p-values below the level; NaN without any."""
    known = p.dropna()
    return float((known < LEVEL).mean()) if len(known) else float("nan")


def noise_rows(models: Sequence[AuditedModel]) -> pd.DataFrame:
    """One row per model: what METHOD 3b promises of the noise models."""
    rows = {}
    for model in models:
        images = model.images[model.images.verdict_ks != Verdict.UNDETERMINED]
        if not len(images) or images.num_inliers.median() < MIN_INLIERS:
            continue
        white = model.whitened.loc[images.index]
        rows[model.name] = {
            "images": len(images),
            "inliers": images.num_inliers.median(),
            "ks constant": share(images.ks_constant_p),
            "ks whitened": share(white["ks_p"]),
            "ks track": share(images.ks_p),
            "ks_fitted track": share(images.ks_fitted_p),
            "dap track": share(images.dap_p),
            "kurt constant": images.kurtosis_constant.median(),
            "kurt whitened": white["kurtosis"].median(),
            "kurt track": images.kurtosis_excess.median(),
            "nu0": model.model["noise_nu0"],
            "s0 px": model.model["noise_s0_px"],
            "removable": model.model["removable_share"],
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def noise_part(models: Sequence[AuditedModel]) -> list[str]:
    """The table of noise models."""
    rows = noise_rows(models)
    out = ["## Noise models on real data", "", NOISE_INTRO.format(least=MIN_INLIERS), ""]
    out += ["| model | " + " | ".join(rows.columns) + " |", "|---|" + "---:|" * len(rows.columns)]
    # a model that is there as text too counts once in the medians
    distinct = rows.round(6).drop_duplicates()
    datasets = pd.Series({model.name: model.dataset for model in models})[distinct.index]
    groups = [(f"**median of {dataset} ({len(part)})**", part) for dataset, part in distinct.groupby(datasets)]
    groups += [(f"**median of all {len(distinct)}**", distinct)] if len(groups) > 1 else []
    medians = [(name, part.median().to_dict() | {"images": part["images"].sum()}) for name, part in groups]
    for name, row in [*rows.to_dict("index").items(), *medians]:
        out.append(f"| {name} | " + " | ".join(_cell(column, row[column]) for column in rows.columns) + " |")
    return out


def _cell(column: str, value: float) -> str:
    if not np.isfinite(value):
        return "-"
    if column in {"images", "inliers"}:
        return f"{value:.0f}"
    if column.startswith(("ks", "dap")) or column == "removable":
        return f"{value:.0%}" if column != "removable" else f"{value:.1%}"
    return f"{value:.3g}" if column == "nu0" else f"{value:.2f}"


def verdict_part(models: Sequence[AuditedModel]) -> list[str]:
    """The table of verdicts."""
    head = (
        *("model", "cameras", "A/R/U", "0.1.0"),
        *(member.short for member in ASKED),
        *("most frequent reasons", "camera finding", "advice"),
    )
    out = [
        "## Verdicts",
        "",
        VERDICT_INTRO,
        "",
        "| " + " | ".join(head) + " |",
        "|---|---|---:|---:|" + "---:|" * len(ASKED) + "---|---|---|",
    ]
    for model in models:
        texts = (_reasons(model), _finding(model), _advice(model))
        known = (model.name, _cameras(model), _counts(model.images), corpus_before.VERDICTS.get(model.name, "-"))
        out.append("| " + " | ".join((*known, *_rejected_by(model.images), *texts)) + " |")
    total = pd.concat([model.images for model in models])
    known = (f"**{len(models)} models**", "", _counts(total), corpus_before.counts())
    return [*out, "| " + " | ".join((*known, *_rejected_by(total), "", "", "")) + " |"]


def _counts(images: pd.DataFrame) -> str:
    return "/".join(str((images.verdict == verdict).sum()) for verdict in corpus_before.LISTED)


def _rejected_by(images: pd.DataFrame) -> list[str]:
    return [str((images[member] == Verdict.REJECTED).sum()) for member in ASKED]


def _cameras(model: AuditedModel) -> str:
    names = Counter(model.images.camera_model)
    used = model.images.camera_id.nunique()
    sharing = "one each" if used == len(model.images) else "shared" if used == 1 else f"{used} cameras"
    return f"{', '.join(map(str, names))}, {sharing}"


def _reasons(model: AuditedModel) -> str:
    counts = Counter(reason.split(":", 1)[0] for reasons in model.images.reasons for reason in reasons)
    return ", ".join(f"{code} {count}" for code, count in counts.most_common(3)) or "-"


def _finding(model: AuditedModel) -> str:
    cameras = model.cameras
    if len(cameras) <= 2:
        found = [
            f"{c.misfit_group} {c.misfit_px:.2f} px, q {c.misfit_q:.0e}"
            for c in cameras[cameras.misfit_px >= _WORTH_NAMING_PX].itertuples()
            if isinstance(c.misfit_group, str)
        ]
        return "; ".join(found) or "none"
    named = model.images.misfit_group[model.images[Member.MISFIT] == Verdict.REJECTED]
    causes = Counter(named)
    return ", ".join(f"{group} {count}" for group, count in causes.most_common(3)) or "none"


def _advice(model: AuditedModel) -> str:
    table = model.cameras if len(model.cameras) <= 2 else model.images
    counts = Counter(advice for advice in table.advised_camera_model if isinstance(advice, str))
    if len(model.cameras) == 1:
        return next(iter(counts), "-")
    return ", ".join(f"{advice} ({count})" for advice, count in counts.most_common(3)) or "-"


def findings_part(models: Sequence[AuditedModel], failures: Sequence[str]) -> list[str]:
    """What is inconsistent, and what cannot be read."""
    out = ["## Findings", "", "What is inconsistent in models that can be read nevertheless.", ""]
    for model in models:
        lines = [f"  - `{finding['code']}` {finding['text']}" for finding in model.model["findings"]]
        out += [f"- {model.name}", *lines] if lines else []
    return [*out, "", "Not readable:", "", *(f"- {line}" for line in failures or ["nothing"])]


def evidence_part(models: Sequence[AuditedModel]) -> list[str]:
    """The numbers behind the explanations, of the models that they are about."""
    shown = [model for model in models if model.share_rejected > MOST]
    head = (
        *("model", "sigma px", *(f"{group} px" for group in GROUPS), "common radial", "common smooth"),
        *("smooth beyond rolling shutter", "smooth by observations", "by cells", "neighbours", "persistence"),
    )
    keys = (
        *(
            "sigma_px",
            *(f"joint_{group}_px" for group in GROUPS),
            "common_radial_px",
            "common_smooth_px",
            "beyond_rs_px",
        ),
        *("by_observations", "by_cells", "neighbours", "persistence"),
    )
    out = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * len(keys)]
    for model in shown:
        cells = (_number(key, model.numbers.get(key, float("nan"))) for key in keys)
        out.append(f"| {model.name} | " + " | ".join(cells) + " |")
    return out


def _number(key: str, value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.0%}" if key.startswith("by_") else f"{value:.2f}"


def explanations_part(models: Sequence[AuditedModel]) -> tuple[list[str], list[str]]:
    """The section, and what is wrong with it: missing texts, and claims that the numbers no longer support."""
    out = ["## Why more than half of the images is rejected", "", EXPLAIN_INTRO, "", *evidence_part(models), ""]
    problems: list[str] = []
    told: dict[int, str] = {}  # by text: two models can be the same reconstruction
    for model in models:
        if model.share_rejected <= MOST:
            continue
        explanation = EXPLANATIONS.get(model.name)
        if explanation is None:
            problems.append(f"{model.name}: {model.share_rejected:.0%} rejected, and nobody says why")
            continue
        problems += [f"{model.name}: {line}" for line in explanation.unsupported(model.numbers)]
        twin = told.setdefault(id(explanation), model.name)
        text = explanation.told(model.numbers) if twin == model.name else f"The same reconstruction as {twin}."
        out += [_paragraph(f"**{model.name}** ({model.num_rejected} of {len(model.images)} rejected). {text}"), ""]
    return out[:-1], problems


def ended_part(models: Sequence[AuditedModel]) -> tuple[list[str], list[str]]:
    """What version 0.1.0 rejected by KS, and what is said of it now; and claims that the numbers do not support."""
    out, problems = ["## What KS alone rejected before", ""], []
    for model in models:
        if model.name in ENDED:
            explanation = ENDED[model.name]
            problems += [f"{model.name}: {line}" for line in explanation.unsupported(model.numbers)]
            counts = f"{_counts(model.images)}, before {corpus_before.VERDICTS.get(model.name, '-')}"
            out += [_paragraph(f"**{model.name}** ({counts}). {explanation.told(model.numbers)}"), ""]
    return out[:-1], problems


def _paragraph(text: str) -> str:
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def check_bands(models: Sequence[AuditedModel]) -> list[str]:
    """Medians that leave the bands measured on the whole corpus."""
    rows = noise_rows(models)
    medians = rows.median()
    bands = {"ks constant": (0.9, 1.0), "ks track": (0.0, 0.45), "kurt track": (-0.35, 0.35)}
    print(
        rows[["images", "ks constant", "ks whitened", "ks track", "kurt constant", "kurt track"]].to_string(
            float_format="%.2f"
        )
    )
    return [
        f"median of {column} is {medians[column]:.3f}, not in {low} .. {high}"
        for column, (low, high) in bands.items()
        if not low <= medians[column] <= high
    ]


def document(models: Sequence[AuditedModel], failures: Sequence[str]) -> tuple[str, list[str]]:
    """Return the page, and what is wrong with its texts."""
    explained, problems = explanations_part(models)
    ended, more = ended_part(models)
    total = sum(len(model.images) for model in models)
    intro = [
        "# What the audit says of public models",
        "",
        "Made by `scripts/corpus_report.py`; do not edit.",
        "",
        f"{len(models)} reconstructions, {total} images: public models of other people, and a few made for this",
        "project from public photos. None of them is part of this repository.",
    ]
    parts = [
        *(
            intro,
            corpus_before.page_part(pd.concat([model.images for model in models])),
            verdict_part(models),
            explained,
            ended,
        ),
        *(noise_part(models), findings_part(models, failures)),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n", [*problems, *more]


def main() -> int:
    """Write the page, or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help="COLMAP models or folders of them")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs" / "corpus.md")
    parser.add_argument("--quick", action="store_true", help="a few models against their bands; writes nothing")
    args = parser.parse_args()
    folders = corpus_folders(args.folders)
    if not folders:
        print("skipped: no corpus of real models here (SFM_AUDIT_CORPUS names one)")
        return 0
    models, failures = read_all(folders, only=QUICK_MODELS if args.quick else None)
    if args.quick:
        problems = check_bands(models) if models else []
        print("" if models else f"skipped: none of {', '.join(QUICK_MODELS)} is there")
    else:
        text, problems = document(models, failures)
        args.out.write_text(text, encoding="utf-8")
    for line in problems:
        print("NOT SUPPORTED:" if not args.quick else "OUT OF BAND:", line, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
