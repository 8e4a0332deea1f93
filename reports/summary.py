"""What does a user want to know right after a run? A page for the terminal, made from the run folder alone.

Nothing is computed here that the tables do not hold: rows are picked, ordered, counted.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Final

from reports.drawing import Field, Listing, Page, draw
from reports.reader import Row, RunReader
from reports.reasons import reasons_part
from reports.wording import MISSING, counted, natural_key, number, paragraph, plain, probability, px, shorten

VERDICT_ORDER: Final = {"rejected": 0, "undetermined": 1, "accepted": 2}
VERDICT_STYLE: Final = {"rejected": "red", "undetermined": "yellow", "accepted": "green"}
VERDICTS: Final = {
    "ks": ("verdict_ks", "is the noise what the noise model says?"),
    "misfit": ("verdict_misfit", "does the camera model hold?"),
    "pose": ("verdict_pose", "is the pose at its optimum?"),
    "plausible": ("plausible", "is it a camera, and well observed?"),
}
POLICIES: Final = {
    "paper": "verdict_ks alone",
    "camera": "misfit, pose and plausible",
    "full": "all four",
}
MODEL_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "num_images", "num_accepted", "num_rejected", "num_undetermined"),
    *("stored_error_px", "recomputed_point_error_px", "noise_s0_px", "share_stale_point_errors", "findings"),
    "num_nonstationary_images",
    *(f"num_{verdict}_{member}" for member in VERDICTS for verdict in VERDICT_ORDER),
)
IMAGE_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "image_name", "num_inliers", "rms_px", "sigma_predicted_px"),
    *("sigma_constant_px", "noise_model", "ks_stat", "ks_p", "misfit_group", "misfit_px", "pose_offset_px"),
    *("coverage", "verdict", "verdict_ks", "verdict_misfit", "verdict_pose", "plausible"),
)
CAMERA_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "camera_id", "camera_model", "num_images"),
    *("misfit_group", "misfit_px", "misfit_material", "advised_camera_model"),
)
MAX_MODELS: Final = 40
MAX_IMAGES_OF_ONE: Final = 25
MAX_IMAGES_OF_MANY: Final = 12
MAX_LINES: Final = 12  # of cameras, of findings, of failures
SHORT_GROUP: Final = {"principal_point": "principal", "rolling_shutter": "rolling"}
STALE_SHARE: Final = 0.01
CAVEATS: Final = (
    (
        "KS judges the noise, misfit the camera: KS can reject a correct camera whose noise is odd, and accept a wrong "
        "lens."
    ),
    (
        "An accepted image agrees with its own reconstruction, which cannot see symmetric mis-registration, "
        "global scale or drift."
    ),
)


def render_summary(run: RunReader, page: Page) -> str:
    """Return the page as text; every line at most ``page.width`` cells wide (unless that is below 60)."""
    models = sorted(run.rows("models", MODEL_COLUMNS), key=_model_order)
    several = len({row["dataset"] for row in models}) > 1
    parts = [
        paragraph(_heading(run), page.width, "  "),
        *_models_part(models, page, several=several),
        *_verdicts_part(run, models, page),
        *_images_part(run, models, page, several=several),
        *_cameras_part(run, models, page, several=several),
    ]
    parts += [*_findings_part(models, page, several=several), *_failures_part(run, page), *_closing(run, models, page)]
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _heading(run: RunReader) -> str:
    config = run.info["config"]
    settings = {"noise": "noise", "points": "points", "policy": "policy", "alpha": "alpha", "min_effect": "min effect"}
    said = ", ".join(f"{words} {config.get(name)}" for name, words in settings.items())
    return f"sfm-audit {run.info['version']}: {said}"


def _models_part(models: Sequence[Row], page: Page, *, several: bool) -> list[str]:
    if not models:
        return ["No model was audited."]
    shown = list(models)
    title = counted(len(models), "model")
    if len(models) > MAX_MODELS:
        shown = heapq.nsmallest(MAX_MODELS, models, key=lambda row: (-_share_rejected(row), _model_order(row)))
        title += f"; the {MAX_MODELS} with the largest share of rejected images, all are in RUN/models"
    fields = [
        Field("images", lambda r: str(r["num_images"])),
        Field("ac-\ncepted", lambda r: str(r["num_accepted"])),
        Field("re-\njected", lambda r: str(r["num_rejected"]), lambda r: "red" if r["num_rejected"] else ""),
        Field("unde-\ntermined", lambda r: str(r["num_undetermined"])),
        Field("error px\nstored", lambda r: px(r["stored_error_px"]), _stale_style),
        Field("error px\nrecomp.", lambda r: px(r["recomputed_point_error_px"])),
        Field("noise\npx", lambda r: px(r["noise_s0_px"])),
        Field("find-\nings", lambda r: str(len(r["findings"] or [])), lambda r: "yellow" if r["findings"] else ""),
    ]
    names = [[_model_name(row, several=several)] for row in shown]
    return [draw(Listing(title, "model", names, shown), fields, page)]


def _verdicts_part(run: RunReader, models: Sequence[Row], page: Page) -> list[str]:
    """Count every verdict, and the policy's, over all images."""
    if not models:
        return []
    policy = run.info["config"]["policy"]
    asked = [(f"_{member}", column, question) for member, (column, question) in VERDICTS.items()]
    asked.append(("", f"policy {policy}", POLICIES[policy]))
    rows: list[Row] = [
        {**{v: sum(row[f"num_{v}{suffix}"] for row in models) for v in VERDICT_ORDER}, "question": question}
        for suffix, _, question in asked
    ]
    fields = [
        Field("ac-\ncepted", lambda r: str(r["accepted"])),
        Field("re-\njected", lambda r: str(r["rejected"]), lambda r: "red" if r["rejected"] else ""),
        Field("unde-\ntermined", lambda r: str(r["undetermined"])),
        Field("which asks", lambda r: r["question"], numeric=False),
    ]
    names = [[name] for _, name, _ in asked]
    return [draw(Listing("Verdicts", "verdict", names, rows), fields, page)]


def _images_part(run: RunReader, models: Sequence[Row], page: Page, *, several: bool) -> list[str]:
    total = sum(row["num_images"] for row in models)
    if total == 0:
        return []
    limit = MAX_IMAGES_OF_ONE if len(models) == 1 else MAX_IMAGES_OF_MANY
    rows = heapq.nsmallest(min(limit, total), run.rows("images", IMAGE_COLUMNS), key=_image_order)
    title = "Images" if len(rows) == total else "The worst images"
    where = [[_model_name(row, several=several)] if len(models) > 1 else [] for row in rows]
    names = [[*model, plain(row["image_name"])] for row, model in zip(rows, where, strict=True)]
    fields = [
        Field(
            "verdict", lambda r: r["verdict"] or MISSING, lambda r: VERDICT_STYLE.get(r["verdict"], ""), numeric=False
        ),
        Field("in-\nliers", lambda r: str(r["num_inliers"])),
        Field("rms\npx", lambda r: px(r["rms_px"])),
        Field("noise\npx", lambda r: px(_noise_px(r))),
        Field("KS\np", lambda r: probability(r["ks_p"]), lambda r: VERDICT_STYLE.get(r["verdict_ks"], "")),
        Field("misfit\npx", _misfit, lambda r: VERDICT_STYLE.get(r["verdict_misfit"], "")),
        Field("pose\npx", lambda r: number(r["pose_offset_px"]), lambda r: VERDICT_STYLE.get(r["verdict_pose"], "")),
        Field(
            "cover-\nage",
            lambda r: number(r["coverage"]),
            lambda r: VERDICT_STYLE.get(r["plausible"], ""),
            optional=True,
        ),
    ]
    listing = Listing(f"{title} (rejected first, then by misfit, then by KS distance)", "image", names, rows)
    text = draw(listing, fields, page)
    if len(rows) < total:
        text += f"... and {total - len(rows)} more, see {plain(str(run.folder))}/images\n"
    return [text, *reasons_part(run, page.width)]


def _cameras_part(run: RunReader, models: Sequence[Row], page: Page, *, several: bool) -> list[str]:
    """List the cameras of several images that have, over all of them, a misfit that matters."""
    found = [row for row in run.rows("cameras", CAMERA_COLUMNS) if row["num_images"] > 1 and row["misfit_material"]]
    lines = []
    for row in sorted(found, key=lambda row: (-row["misfit_px"], _model_order(row), row["camera_id"])):
        where = "" if len(models) == 1 else f"{shorten(_model_name(row, several=several), 30)} "
        what = f"{row['camera_model']}, {row['num_images']} images: {row['misfit_group']} {number(row['misfit_px'])} px"
        advice = plain(row["advised_camera_model"] or "none")
        lines.append(paragraph(f"  {where}camera {row['camera_id']}  {what}; advice: {advice}", page.width, "    "))
    return _limited("Shared cameras that do not fit, all their images together", lines, "RUN/cameras")


def _findings_part(models: Sequence[Row], page: Page, *, several: bool) -> list[str]:
    """List what is inconsistent in the models; of a code that many models share, the first model's text."""
    by_code: defaultdict[str, list[tuple[Row, Any]]] = defaultdict(list)
    for row in models:
        for finding in row["findings"] or []:
            by_code[finding["code"]].append((row, finding))
    lines = []
    for code, found in sorted(by_code.items(), key=lambda item: (-len(item[1]), item[0])):
        row, finding = found[0]
        where = "" if len(models) == 1 else f"{shorten(_model_name(row, several=several), 30)}: "
        more = f" (and in {counted(len(found) - 1, 'other model')})" if len(found) > 1 else ""
        lines.append(paragraph(f"  {code}  {where}{plain(finding['text'])}{more}", page.width, "    "))
    return _limited("Findings: what is inconsistent in the models", lines, "RUN/models")


def _failures_part(run: RunReader, page: Page) -> list[str]:
    lines = [paragraph(f"  {plain(item['message'])}", page.width, "    ") for item in run.info.get("failures", [])]
    return _limited("Not audited", lines, "RUN/run.json")


def _limited(title: str, lines: Sequence[str], elsewhere: str) -> list[str]:
    if not lines:
        return []
    rest = [f"  ... and {len(lines) - MAX_LINES} more, see {elsewhere}"] if len(lines) > MAX_LINES else []
    return ["\n".join([title, *lines[:MAX_LINES], *rest])]


def _closing(run: RunReader, models: Sequence[Row], page: Page) -> list[str]:
    total, accepted, rejected, undetermined = (
        sum(row[name] for row in models) for name in ("num_images", "num_accepted", "num_rejected", "num_undetermined")
    )
    verdicts = f"{accepted} accepted, {rejected} rejected, {undetermined} undetermined"
    lines = [f"{counted(total, 'image')}: {verdicts}."]
    lines += [paragraph(f"- {text}", page.width, "  ") for text in CAVEATS]
    stale = sum((row["share_stale_point_errors"] or 0) > STALE_SHARE for row in models)
    steps = []
    if stale:
        steps.append(f"Stored errors are not the points' errors in {counted(stale, 'model')}: do not filter by them.")
    if rejected:
        steps.append("Look at the rejected images before you train, measure or benchmark with them.")
    moved = sum(row["num_nonstationary_images"] or 0 for row in models)
    if moved:
        limit = run.info["config"]["pose_offset_threshold_px"]
        what = "is" if moved == 1 else "are"
        steps.append(
            f"{counted(moved, 'image')} {what} not where adjustment would put them (pose > {limit} px): adjust."
        )
    if undetermined:
        steps.append("Undetermined is no pass: these images do not say enough about themselves.")
    folder = plain(str(run.folder))
    steps.append(
        f'All numbers: pandas.read_parquet("{folder}/images"), "{folder}/models"; docs/tables.md explains the columns'
    )
    return ["\n".join(lines), "\n".join(["Next", *(paragraph(f"- {step}", page.width, "  ") for step in steps)])]


def _model_order(row: Row) -> Any:
    return natural_key(row["dataset"], row["scene"], row["component"], row["model_path"])


def _image_order(row: Row) -> Any:
    misfit, distance = (row[name] if row[name] is not None else 0.0 for name in ("misfit_px", "ks_stat"))
    where = (_model_order(row), natural_key(row["image_name"]))
    return (VERDICT_ORDER.get(row["verdict"], 1), -misfit, -distance, *where)


def _model_name(row: Row, *, several: bool) -> str:
    name = f"{row['scene']}/{row['component']}"
    return plain(f"{row['dataset']}/{name}" if several else name)


def _share_rejected(row: Row) -> float:
    return float(row["num_rejected"] / row["num_images"]) if row["num_images"] else 0.0


def _noise_px(row: Row) -> float | None:
    value = row["sigma_constant_px"] if row["noise_model"] == "constant" else row["sigma_predicted_px"]
    return None if value is None else float(value)


def _misfit(row: Row) -> str:
    group = row["misfit_group"]
    return MISSING if group is None else f"{SHORT_GROUP.get(group, group)} {number(row['misfit_px'])}"


def _stale_style(row: Row) -> str:
    return "yellow" if (row["share_stale_point_errors"] or 0) > STALE_SHARE else ""
