"""docs/corpus.md: verdicts, what to do, evidence and findings of a corpus. Everything on it is from the product."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

import pandas as pd

from scripts.corpus.models import CorpusModel
from scripts.corpus.noise import noise_part
from sfm_audit.audit.table.words import GROUPS, Member, Verdict

ASKED: Final = tuple(member for member in Member if member is not Member.OUTSIDE)
VERDICTS: Final = (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED)
MOST_REASONS: Final = 12
WORTH_NAMING_PX: Final = 0.05  # of a pooled finding: with a million observations a thousandth of a pixel is significant
HEAD: Final = """\
# What the audit says of public models

Made by `scripts/corpus_report.py` from `sfm-audit run` and `sfm-audit diagnose`; do not edit.

{models} reconstructions, {images} images: public models of other people, and a few made for this project from public
photos. None of them is part of this repository. A share that is rejected here is no error rate: nobody knows the truth
of these models ([realtruth.md](realtruth.md) has models where it is known).

## How many, and for what

Default settings: noise `track`, policy `standard`, effects below 0.2 px ignored. An image can be rejected by several
verdicts and have several reasons (the {most} most frequent reasons are shown; [codes.md](codes.md) explains them).
`verdict_ks` decides nothing under `standard`."""
MODELS_INTRO: Final = """\
## Models

A/R/U: images accepted, rejected, undetermined. misfit, camera, pose, plausible, noise, ks: images that this verdict
rejects. Camera finding: what the pooled test says of a shared camera (its cause, px, q, from 0.05 px on); for cameras
with one image each, how often which cause is named of images that misfit rejects. Diagnosis: the most urgent one
([diagnose.md](diagnose.md)); what to do about it stands below."""
ACTIONS_INTRO: Final = """\
## What is the matter, and what to do

What `sfm-audit diagnose RUN` says of every model that something speaks against: its diagnoses, the most urgent
first, with the images that each is about and what to do; what the residuals say beyond the tables; what bundle
adjustment does, as the model is (the control) and with larger camera models (pycolmap, principal points fixed), audited
again; and what follows. Models of more than 150 images are not refitted here. [diagnose.md](diagnose.md) explains how
each sentence is found and what not to conclude."""
EVIDENCE_INTRO: Final = """\
## The numbers behind it

Of the models above whose images were tested; medians over images, px. The groups: what the joint test found and nothing
else could take up. The rest is of the residuals as they stand:

- *common*: RMS length of the field that all images have in common, each image's own pose and intrinsics profiled. A
  lens that is wrong in all images shows there; motion, which differs from image to image, does not.
- *beyond rolling shutter*: the smooth field that is left when a pose that changes linearly from row to row was allowed.
- *by observations*, *by cells*: share of images with a significant smooth field when every observation counts, and when
  all in a cell of 1/24 of the image's longer side count as one. Neighbours share errors in real models (several
  keypoints on one spot, points on one badly placed surface), and the tests do not know it: where *by cells* is far
  lower, part of the significance is that.
- *neighbours*: correlation of the residuals of points less than 1/40 of the longer side apart (same keypoint left out).
- *persistence*: correlation of a point's residuals in one image and the next one by name."""
EVIDENCE: Final = {
    "sigma": "sigma_px",
    **{group.replace("_", " "): f"joint_{group}_px" for group in GROUPS},
    "common radial": "common_radial_px",
    "common smooth": "common_smooth_px",
    "smooth beyond rolling shutter": "beyond_rs_px",
    "smooth by observations": "by_observations",
    "by cells": "by_cells",
    "neighbours": "neighbours",
    "persistence": "persistence",
}
"""Heading -> number of ``diagnose --json``."""


def document(models: Sequence[CorpusModel], unread: Sequence[str]) -> str:
    """Return the page.

    Parameters
    ----------
    unread : what could not be read, a line each
    """
    images = pd.concat([model.images for model in models])
    head = HEAD.format(models=len(models), images=len(images), most=MOST_REASONS)
    parts = [
        [head, "", *_shares(images)],
        [MODELS_INTRO, "", *_verdict_table(models, images)],
        [ACTIONS_INTRO, "", *_actions(models)],
        [EVIDENCE_INTRO, "", *_evidence_table(models)],
        noise_part(models),
        _findings(models, unread),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def without_action(models: Sequence[CorpusModel]) -> list[str]:
    """Return the models of which an image that is not accepted belongs to no diagnosis with an action, in words."""
    out = []
    for model in models:
        told = sum(each["num_images"] or 0 for each in model.diagnoses if each["action"] and each["code"] != "sound")
        open_images = len(model.images) - model.num(Verdict.ACCEPTED)
        if told < open_images:
            out.append(f"{model.name}: {open_images} images are not accepted, diagnoses speak of {told}")
        if open_images and model.found is None:
            out.append(f"{model.name}: was not diagnosed")
        if model.found is not None and model.found["problem"]:
            out.append(f"{model.name}: {model.found['problem']}")
    return out


def _shares(images: pd.DataFrame) -> list[str]:
    rows = [(str(verdict), int((images.verdict == verdict).sum())) for verdict in VERDICTS]
    rows += [(f"rejected by `{member}`", int((images[member] == Verdict.REJECTED).sum())) for member in ASKED]
    said = Counter(
        (str(verdict), code)
        for verdict, reasons in zip(images.verdict, images.reasons, strict=True)
        for code in {reason.split(":", 1)[0] for reason in reasons}
    )
    rows += [(f"{verdict}, `{code}`", num) for (verdict, code), num in said.most_common(MOST_REASONS)]
    return ["| images | |", "|---|---:|", *(f"| {words} | {n} ({n / len(images):.0%}) |" for words, n in rows)]


def _verdict_table(models: Sequence[CorpusModel], images: pd.DataFrame) -> list[str]:
    names = [member.short for member in ASKED]
    head = ("model", "cameras", "A/R/U", *names, "most frequent reasons", "camera finding", "diagnosis")
    out = ["| " + " | ".join(head) + " |", "|---|---|---:|" + "---:|" * len(ASKED) + "---|---|---|"]
    for model in models:
        texts = (_reasons(model), _camera_finding(model), ", ".join(str(each["code"]) for each in model.diagnoses[:1]))
        known = (model.name, _cameras(model), _counts(model.images), *_rejected_by(model.images), *texts)
        out.append("| " + " | ".join(known) + " |")
    known = (f"**{len(models)} models**", "", _counts(images), *_rejected_by(images), "", "", "")
    return [*out, "| " + " | ".join(known) + " |"]


def _counts(images: pd.DataFrame) -> str:
    return "/".join(str((images.verdict == verdict).sum()) for verdict in VERDICTS)


def _rejected_by(images: pd.DataFrame) -> list[str]:
    return [str((images[member] == Verdict.REJECTED).sum()) for member in ASKED]


def _cameras(model: CorpusModel) -> str:
    used = model.images.camera_id.nunique()
    sharing = "one each" if used == len(model.images) else "shared" if used == 1 else f"{used} cameras"
    return f"{', '.join(Counter(model.images.camera_model))}, {sharing}"


def _reasons(model: CorpusModel) -> str:
    counts = Counter(reason.split(":", 1)[0] for reasons in model.images.reasons for reason in reasons)
    return ", ".join(f"{code} {count}" for code, count in counts.most_common(3)) or "-"


def _camera_finding(model: CorpusModel) -> str:
    cameras = model.cameras
    if len(cameras) <= 2:
        found = [
            f"{camera.misfit_group} {camera.misfit_px:.2f} px, q {camera.misfit_q:.0e}"
            for camera in cameras[cameras.misfit_px >= WORTH_NAMING_PX].itertuples()
            if isinstance(camera.misfit_group, str)
        ]
        return "; ".join(found) or "none"
    causes = Counter(model.images.misfit_group[model.images[Member.MISFIT] == Verdict.REJECTED])
    return ", ".join(f"{group} {count}" for group, count in causes.most_common(3)) or "none"


def _actions(models: Sequence[CorpusModel]) -> list[str]:
    out: list[str] = []
    told: dict[str, str] = {}  # two models can be the same reconstruction, as binary and as text
    for model in models:
        if model.found is None:
            continue
        said = [*_diagnosis_lines(model.diagnoses), "", "Residuals and refits:", "", *_found_lines(model.found)]
        twin = told.setdefault("\n".join(said), model.name)
        text = said if twin == model.name else [f"The same reconstruction as {twin}, and the same result."]
        out += [f"### {model.name}", "", *text, ""]
    return out[:-1]


def _diagnosis_lines(diagnoses: Sequence[Mapping[str, Any]]) -> list[str]:
    out = []
    for each in diagnoses:
        severity = f", {each['severity']}" if each["severity"] else ""
        num = each["num_images"] or 0
        whose = f"{num} image{'' if num == 1 else 's'}{severity}"
        out.append(_item(f"`{each['code']}` ({whose}): {each['text']}. **Do**: {each['action']}."))
    return out


def _found_lines(found: Mapping[str, Any]) -> list[str]:
    if found["problem"]:
        return [_item(f"Not diagnosed: {found['problem']}")]
    refits = [f"Adjusted as {each['reading']}" if i else f"Adjusted {each['reading']}" for i, each in _refits(found)]
    return [*map(_item, [*found["readings"], *refits]), _item(f"**{found['conclusion']}**")]


def _refits(found: Mapping[str, Any]) -> list[tuple[int, Mapping[str, Any]]]:
    return list(enumerate(found["refits"]))


def _item(text: str) -> str:
    return textwrap.fill(
        text, 120, initial_indent="- ", subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


def _evidence_table(models: Sequence[CorpusModel]) -> list[str]:
    out = ["| model | " + " | ".join(EVIDENCE) + " |", "|---|" + "---:|" * len(EVIDENCE)]
    for model in models:
        numbers = model.found["numbers"] if model.found else {}
        if numbers.get("by_observations") is not None:
            cells = (_number(key, numbers.get(key)) for key in EVIDENCE.values())
            out.append(f"| {model.name} | " + " | ".join(cells) + " |")
    return out


def _number(key: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}" if key.startswith("by_") else f"{value:.2f}"


def _findings(models: Sequence[CorpusModel], unread: Sequence[str]) -> list[str]:
    out = ["## Findings", "", "What is inconsistent in models that can be read nevertheless.", ""]
    for model in models:
        lines = [f"  - `{finding['code']}` {finding['text']}" for finding in model.model["findings"]]
        out += [f"- {model.name}", *lines] if lines else []
    return [*out, "", "Not readable:", "", *(f"- {line}" for line in unread or ["nothing"])]
