"""What does a user want to know right after a run? A page for the terminal, made from the run folder alone.

Nothing is computed here that the tables do not hold: rows are picked, ordered, counted.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sfm_audit.audit.table.words import MEMBER_QUESTIONS, POLICY_WORDS, SEVERITY_ORDER, VERDICT_ORDER, Member, Verdict
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.drawing import Field, Listing, Page, draw
from sfm_audit.reports.text.legend import legend, settings_words
from sfm_audit.reports.text.reasons import reasons_part
from sfm_audit.reports.text.triage import MAX_DIAGNOSES, triage_part, urgency
from sfm_audit.reports.text.witnesses import witnesses_line
from sfm_audit.reports.text.wording import (
    MISSING,
    counted,
    natural_key,
    number,
    paragraph,
    plain,
    probability,
    px,
    shorten,
)

VERDICT_STYLE: Final[dict[str, str]] = {
    Verdict.REJECTED: "red",
    Verdict.UNDETERMINED: "yellow",
    Verdict.ACCEPTED: "green",
}
MODEL_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "num_images", "num_accepted", "num_rejected", "num_undetermined"),
    *("stored_error_px", "recomputed_observation_error_px", "noise_s0_px", "share_stale_point_errors", "findings"),
    *("num_nonstationary_images", "witnesses", "diagnoses"),
    *(f"num_{verdict}_{member.short}" for member in Member for verdict in Verdict),
)
IMAGE_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "image_name", "num_inliers", "rms_px", "sigma_predicted_px"),
    *("sigma_constant_px", "noise_model", "ks_stat", "ks_p", "misfit_group", "misfit_px", "pose_offset_px"),
    *("coverage", "verdict", "severity", *map(str, Member)),
)
CAMERA_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "camera_id", "camera_model", "num_images"),
    *("misfit_group", "misfit_px", "misfit_material", "advised_camera_model"),
)
LABELS: Final = ("dataset", "scene", "component", "model_path")
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
        "global scale or drift; docs/witnesses.md says who can, and how often."
    ),
)


class _Smallest:
    """The first ``limit`` rows in the order of a key, of any number that go by; as `heapq.nsmallest`, row by row."""

    def __init__(self, limit: int, key: Callable[[Row], Any]) -> None:
        self._limit, self._key = limit, key
        self._rows: list[Row] = []

    def add(self, row: Row) -> None:
        """Look at one more row."""
        self._rows.append(row)
        if len(self._rows) >= 2 * self._limit + 100:
            self._rows = self.rows()

    def rows(self) -> list[Row]:
        """Return the first rows so far, in order."""
        return heapq.nsmallest(self._limit, self._rows, key=self._key)


@dataclass(slots=True)
class _Found:
    """A finding code: how many findings, and the text of the one that comes first in the order of the models."""

    count: int
    order: Any
    model: Row
    text: str


@dataclass(slots=True)
class _Models:
    """What the page needs of the table of models, which may be long: sums, and a few rows.

    sums: of the counting columns.    witnesses: in how many models each was asked.
    first, worst: rows by name, and by share of rejected images.
    """

    num_models: int = 0
    datasets: set[str] = field(default_factory=set)
    sums: Counter[str] = field(default_factory=Counter)
    num_stale: int = 0
    witnesses: Counter[str] = field(default_factory=Counter)
    findings: dict[str, _Found] = field(default_factory=dict)
    first: _Smallest = field(default_factory=lambda: _Smallest(MAX_MODELS, _model_order))
    worst: _Smallest = field(
        default_factory=lambda: _Smallest(MAX_MODELS, lambda row: (-_share_rejected(row), _model_order(row)))
    )

    diagnoses: _Smallest = field(default_factory=lambda: _Smallest(MAX_DIAGNOSES, urgency))
    num_diagnoses: int = 0

    @classmethod
    def read(cls, rows: Iterable[Row]) -> _Models:
        """Go through the rows once; they may come in any order."""
        models = cls()
        for row in rows:
            models.num_models += 1
            models.datasets.add(row["dataset"])
            models.sums.update({name: row[name] or 0 for name in MODEL_COLUMNS if name.startswith("num_")})
            models.witnesses.update(row["witnesses"] or [])
            models.num_stale += (row["share_stale_point_errors"] or 0) > STALE_SHARE
            models.first.add(row)
            models.worst.add(row)
            models._add_findings(row)
            for diagnosis in row.get("diagnoses") or []:
                models.diagnoses.add({**diagnosis, **{name: row[name] for name in LABELS}})
                models.num_diagnoses += 1
        return models

    def _add_findings(self, row: Row) -> None:
        order = _model_order(row) if row["findings"] else None
        for finding in row["findings"] or []:
            found = self.findings.setdefault(finding["code"], _Found(0, order, row, finding["text"]))
            found.count += 1
            if order < found.order:
                found.order, found.model, found.text = order, row, finding["text"]

    @property
    def several(self) -> bool:
        """Whether there are several data sets."""
        return len(self.datasets) > 1


def render_summary(run: RunReader, page: Page) -> str:
    """Return the page as text; every line at most ``page.width`` cells wide (unless that is below 60).

    Tables are read part by part, and only what the page shows is kept: memory does not grow with the run.
    """
    models = _Models.read(run.rows("models", MODEL_COLUMNS))
    parts = [
        paragraph(_heading(run, models), page.width, "  "),
        *_models_part(models, page),
        *_verdicts_part(run, models, page),
        *_images_part(run, models, page),
        *_cameras_part(run, models, page),
    ]
    parts += [*_findings_part(models, page), *_failures_part(run, page)]
    parts += [
        *triage_part(models.diagnoses.rows(), models.num_diagnoses, run.folder, page, _where(models)),
        *_closing(run, models, page),
    ]
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _where(models: _Models) -> Callable[[Row], str] | None:
    """Return how a model is called; None where there is one only."""
    return None if models.num_models == 1 else lambda row: _model_name(row, several=models.several)


def _heading(run: RunReader, models: _Models) -> str:
    said = settings_words(run.info["config"], has_witnesses=bool(models.witnesses))
    again = f"; decided again: {run.info['decided_again']}" if run.info.get("decided_again") else ""
    return f"sfm-audit {run.info['version']}: {said}{again}"


def _models_part(models: _Models, page: Page) -> list[str]:
    if not models.num_models:
        return ["No model was audited."]
    shown = models.first.rows()
    title = counted(models.num_models, "model")
    if models.num_models > MAX_MODELS:
        shown = models.worst.rows()
        title += f"; the {MAX_MODELS} with the largest share of rejected images, all are in RUN/models"
    fields = [
        Field("images", lambda r: str(r["num_images"])),
        Field("ac-\ncepted", lambda r: str(r["num_accepted"])),
        Field("re-\njected", lambda r: str(r["num_rejected"]), lambda r: "red" if r["num_rejected"] else ""),
        Field("unde-\ntermined", lambda r: str(r["num_undetermined"])),
        Field("error px\nstored", lambda r: px(r["stored_error_px"]), _stale_style),
        Field("error px\nobserv.", lambda r: px(r["recomputed_observation_error_px"])),
        Field("noise\npx", lambda r: px(r["noise_s0_px"])),
        Field("find-\nings", lambda r: str(len(r["findings"] or [])), lambda r: "yellow" if r["findings"] else ""),
    ]
    names = [[_model_name(row, several=models.several)] for row in shown]
    return [draw(Listing(title, "model", names, shown), fields, page)]


def _verdicts_part(run: RunReader, models: _Models, page: Page) -> list[str]:
    """Count every verdict, and the policy's, over all images."""
    if not models.num_models:
        return []
    policy = run.info["config"]["policy"]
    asked = [
        (f"_{member.short}", str(member), question[0].lower() + question[1:])
        for member, question in MEMBER_QUESTIONS.items()
        if any(models.sums[f"num_{verdict}_{member.short}"] for verdict in Verdict)
    ]
    asked.append(("", f"policy {policy}", POLICY_WORDS.get(policy, "")))
    rows: list[Row] = [
        {**{v: models.sums[f"num_{v}{suffix}"] for v in Verdict}, "question": question} for suffix, _, question in asked
    ]
    fields = [
        Field("ac-\ncepted", lambda r: str(r["accepted"])),
        Field("re-\njected", lambda r: str(r["rejected"]), lambda r: "red" if r["rejected"] else ""),
        Field("unde-\ntermined", lambda r: str(r["undetermined"])),
        Field("which asks", lambda r: r["question"], numeric=False),
    ]
    names = [[name] for _, name, _ in asked]
    return [draw(Listing("Verdicts", "verdict", names, rows), fields, page)]


def _images_part(run: RunReader, models: _Models, page: Page) -> list[str]:
    total = models.sums["num_images"]
    if total == 0:
        return []
    limit = MAX_IMAGES_OF_ONE if models.num_models == 1 else MAX_IMAGES_OF_MANY
    rows = heapq.nsmallest(min(limit, total), run.rows("images", IMAGE_COLUMNS), key=_image_order)
    title = "Images" if len(rows) == total else "The worst images"
    where = [[_model_name(row, several=models.several)] if models.num_models > 1 else [] for row in rows]
    names = [[*model, plain(row["image_name"])] for row, model in zip(rows, where, strict=True)]
    fields = [
        Field(
            "verdict", lambda r: r["verdict"] or MISSING, lambda r: VERDICT_STYLE.get(r["verdict"], ""), numeric=False
        ),
        Field("in-\nliers", lambda r: str(r["num_inliers"])),
        Field("rms\npx", lambda r: px(r["rms_px"])),
        Field("noise\npx", lambda r: px(_noise_px(r))),
        Field("KS\np", lambda r: probability(r["ks_p"]), lambda r: VERDICT_STYLE.get(r[Member.KS], "")),
        Field("misfit\npx", _misfit, lambda r: VERDICT_STYLE.get(r[Member.MISFIT], "")),
        Field("pose\npx", lambda r: number(r["pose_offset_px"]), lambda r: VERDICT_STYLE.get(r[Member.POSE], "")),
        Field(
            "cover-\nage",
            lambda r: number(r["coverage"]),
            lambda r: VERDICT_STYLE.get(r[Member.PLAUSIBLE], ""),
            optional=True,
        ),
    ]
    listing = Listing(f"{title} (rejected first, then by severity, misfit, KS distance)", "image", names, rows)
    text = draw(listing, fields, page)
    if len(rows) < total:
        text += f"... and {total - len(rows)} more, see {plain(str(run.folder))}/images\n"
    return [text, legend(page.width, has_coverage="cover-" in text), *reasons_part(run, page.width)]


def _cameras_part(run: RunReader, models: _Models, page: Page) -> list[str]:
    """List the cameras of several images that have, over all of them, a misfit that matters."""
    worst = _Smallest(MAX_LINES, lambda row: (-row["misfit_px"], _model_order(row), row["camera_id"]))
    count = 0
    for row in run.rows("cameras", CAMERA_COLUMNS):
        if row["num_images"] > 1 and row["misfit_material"]:
            worst.add(row)
            count += 1
    lines = []
    for row in worst.rows():
        where = "" if models.num_models == 1 else f"{shorten(_model_name(row, several=models.several), 30)} "
        what = f"{row['camera_model']}, {row['num_images']} images: {row['misfit_group']} {number(row['misfit_px'])} px"
        advice = plain(row["advised_camera_model"] or "none")
        lines.append(paragraph(f"  {where}camera {row['camera_id']}  {what}; advice: {advice}", page.width, "    "))
    return _limited("Shared cameras that do not fit, all their images together", lines, "RUN/cameras", count)


def _findings_part(models: _Models, page: Page) -> list[str]:
    """List what is inconsistent in the models; of a code that many models share, the first model's text."""
    lines = []
    for code, found in sorted(models.findings.items(), key=lambda item: (-item[1].count, item[0])):
        where = "" if models.num_models == 1 else f"{shorten(_model_name(found.model, several=models.several), 30)}: "
        more = f" (and in {counted(found.count - 1, 'other model')})" if found.count > 1 else ""
        lines.append(paragraph(f"  {code}  {where}{plain(found.text)}{more}", page.width, "    "))
    return _limited("Findings: what is inconsistent in the models", lines, "RUN/models", len(lines))


def _failures_part(run: RunReader, page: Page) -> list[str]:
    lines = [paragraph(f"  {plain(item['message'])}", page.width, "    ") for item in run.info.get("failures", [])]
    return _limited("Not audited", lines, "RUN/run.json", len(lines))


def _limited(title: str, lines: Sequence[str], elsewhere: str, count: int) -> list[str]:
    """Show the first of ``count`` lines, of which the first MAX_LINES at least are given."""
    if not lines:
        return []
    rest = [f"  ... and {count - MAX_LINES} more, see {elsewhere}"] if count > MAX_LINES else []
    return ["\n".join([title, *lines[:MAX_LINES], *rest])]


def _mixed_paths(run: RunReader) -> list[str]:
    """Say that models were computed in different ways, where they were."""
    found = ((run.info.get("kernels") or {}).get("models")) or {}
    if len(found) <= 1:
        return []
    by = ", ".join(f"{number} by {plain(path)}" for path, number in sorted(found.items()))
    return [f"Not all models were computed alike: {by}. Numbers agree to 1e-9 (docs/kernels.md)."]


def _closing(run: RunReader, models: _Models, page: Page) -> list[str]:
    total, accepted, rejected, undetermined = (
        models.sums[name] for name in ("num_images", "num_accepted", "num_rejected", "num_undetermined")
    )
    verdicts = f"{accepted} accepted, {rejected} rejected, {undetermined} undetermined"
    lines = [f"{counted(total, 'image')}: {verdicts}."]
    texts = (*CAVEATS, _witnesses(models), *_mixed_paths(run))
    lines += [paragraph(f"- {text}", page.width, "  ") for text in texts]
    stale = models.num_stale
    steps = []
    if stale:
        steps.append(f"Stored errors are not the points' errors in {counted(stale, 'model')}: do not filter by them.")
    if rejected:
        steps.append("Look at the rejected images before you train, measure or benchmark with them.")
    moved = models.sums["num_nonstationary_images"]
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


def _witnesses(models: _Models) -> str:
    num_spoken_of = sum(models.sums[f"num_{verdict}_{Member.OUTSIDE.short}"] for verdict in Verdict)
    return witnesses_line(
        models.witnesses, models.num_models, models.sums["num_images"], num_spoken_of, models.findings
    )


def _model_order(row: Row) -> Any:
    return natural_key(row["dataset"], row["scene"], row["component"], row["model_path"])


def _image_order(row: Row) -> Any:
    misfit, distance = (row[name] if row[name] is not None else 0.0 for name in ("misfit_px", "ks_stat"))
    where = (_model_order(row), natural_key(row["image_name"]))
    severity = SEVERITY_ORDER.get(row["severity"], len(SEVERITY_ORDER))
    return (VERDICT_ORDER.get(row["verdict"], 1), severity, -misfit, -distance, *where)


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
