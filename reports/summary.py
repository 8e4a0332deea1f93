"""What does a user want to know right after a run? A page for the terminal, made from the run folder alone.

Nothing is computed here that the tables do not hold: rows are picked, ordered, counted.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Final

from reports.drawing import Field, Listing, Page, draw
from reports.reader import Row, RunReader
from reports.wording import MISSING, counted, natural_key, number, paragraph, plain, probability, px, shorten

MODEL_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "num_images", "num_accepted", "num_rejected", "num_undetermined"),
    *("stored_error_px", "recomputed_point_error_px", "noise_s0_px", "share_stale_point_errors", "findings"),
    "num_nonstationary_images",
)
IMAGE_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "image_name", "num_inliers", "rms_px", "sigma_predicted_px"),
    *("sigma_constant_px", "noise_model", "ks_stat", "ks_p", "kurtosis_excess", "pose_offset_px", "verdict", "reasons"),
)
MAX_MODELS: Final = 40
MAX_IMAGES_OF_ONE: Final = 25
MAX_IMAGES_OF_MANY: Final = 12
MAX_LINES: Final = 12  # of findings, of failures
VERDICT_ORDER: Final = {"rejected": 0, "undetermined": 1, "accepted": 2}
VERDICT_STYLE: Final = {"rejected": "red", "undetermined": "yellow", "accepted": "green"}
STALE_SHARE: Final = 0.01
CAVEATS: Final = (
    "KS judges the noise, not the camera: a correct camera with odd noise can be rejected, and a wrong lens can pass.",
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
        _heading(run),
        *_models_part(models, page, several=several),
        *_images_part(run, models, page, several=several),
    ]
    parts += [*_findings_part(models, page, several=several), *_failures_part(run, page), *_closing(run, models, page)]
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _heading(run: RunReader) -> str:
    config = run.info["config"]
    settings = f"noise {config.get('noise')}, policy {config.get('policy')}, alpha {config.get('alpha')}"
    return f"sfm-audit {run.info['version']}: {settings}"


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
        Field("inliers", lambda r: str(r["num_inliers"])),
        Field("rms\npx", lambda r: px(r["rms_px"])),
        Field("noise\npx", lambda r: px(_noise_px(r))),
        Field("KS\nD", lambda r: number(r["ks_stat"], 3)),
        Field("KS\np", lambda r: probability(r["ks_p"])),
        Field("kur-\ntosis", lambda r: number(r["kurtosis_excess"])),
        Field("pose\npx", lambda r: number(r["pose_offset_px"]), _moved_style(run)),
    ]
    text = draw(Listing(f"{title} (rejected first, largest KS distance first)", "image", names, rows), fields, page)
    if len(rows) < total:
        text += f"... and {total - len(rows)} more, see {plain(str(run.folder))}/images\n"
    return [text, *_reasons_part(run, page)]


def _reasons_part(run: RunReader, page: Page) -> list[str]:
    """Count why images are not accepted, by reason code."""
    counts: Counter[str] = Counter()
    examples: dict[str, Row] = {}
    for row in run.rows("images", ("image_name", "reasons")):
        for reason in row["reasons"] or []:
            code = reason.split(":", 1)[0]
            counts[code] += 1
            examples.setdefault(code, {"image": row["image_name"], "reason": reason})
    lines = []
    for code, count in counts.most_common():
        example = examples[code]
        detail = plain(example["reason"].partition(":")[2].strip())
        name = shorten(plain(example["image"]), 30)
        where = f"{name}: {detail}" if detail else name
        lead = f"  {code}  {counted(count, 'image')}, "
        lines.append(paragraph(lead + ("such as " if count > 1 else "") + where, page.width, "    "))
    return ["\n".join(["Why images are not accepted", *lines])] if lines else []


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
    distance = row["ks_stat"] if row["ks_stat"] is not None else 0.0
    return (VERDICT_ORDER.get(row["verdict"], 1), -distance, _model_order(row), natural_key(row["image_name"]))


def _model_name(row: Row, *, several: bool) -> str:
    name = f"{row['scene']}/{row['component']}"
    return plain(f"{row['dataset']}/{name}" if several else name)


def _share_rejected(row: Row) -> float:
    return float(row["num_rejected"] / row["num_images"]) if row["num_images"] else 0.0


def _noise_px(row: Row) -> float | None:
    value = row["sigma_constant_px"] if row["noise_model"] == "constant" else row["sigma_predicted_px"]
    return None if value is None else float(value)


def _moved_style(run: RunReader) -> Callable[[Row], str]:
    limit = run.info["config"]["pose_offset_threshold_px"]
    return lambda row: "red" if (row["pose_offset_px"] or 0) > limit else ""


def _stale_style(row: Row) -> str:
    return "yellow" if (row["share_stale_point_errors"] or 0) > STALE_SHARE else ""
