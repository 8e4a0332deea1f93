"""What of a run stands on the page? Counts over all images, the worst rows, the cameras; read part by part."""

from __future__ import annotations

import heapq
import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from sfm_audit.audit.table import TABLES, Column
from sfm_audit.audit.table.columns import GROUP_COLUMNS
from sfm_audit.audit.table.words import (
    POLICIES,
    SEVERITY_ORDER,
    VERDICT_ORDER,
    Member,
    Verdict,
    is_remark,
    verdict_under,
)
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.html.statements import Statements
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.wording import natural_key

MAX_ROWS: Final = 10_000  # of the image table
MAX_SCENES: Final = 300
MAX_CAMERAS: Final = 40
DISTRIBUTIONS: Final = (
    *("sigma_predicted_px", "sigma_constant_px", "kurtosis_excess", "kurtosis_constant", "misfit_px", "scale_ratio"),
    *("ks_stat", "ks_constant_stat", "ks_p", "ks_constant_p"),
)


@dataclass(slots=True)
class Reason:
    """How many images have a reason, and the first of them."""

    images: int
    example: str
    detail: str


@dataclass(slots=True)
class RunContent:
    """A run, counted.

    counts: question or policy -> verdict -> images.      scenes: (dataset, scene) -> verdict -> images.
    reasons, remarks: by code; remarks decide nothing.    numbers: distributions' column -> one value per image.
    verdicts: one per image.       rows: the worst MAX_ROWS images, the worst first, each with its ``part``.
    cameras: the worst of ``num_cameras``.                models: all model rows.
    outside: what witnesses outside of the images said of them.
    """

    run: RunReader
    counts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    scenes: dict[tuple[str, str], Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    reasons: dict[str, Reason] = field(default_factory=dict)
    remarks: dict[str, Reason] = field(default_factory=dict)
    numbers: dict[str, FloatArray] = field(default_factory=dict)
    verdicts: list[str] = field(default_factory=list)
    noise_model: str | None = None
    rows: list[Row] = field(default_factory=list)
    cameras: list[Row] = field(default_factory=list)
    num_cameras: int = 0
    models: list[Row] = field(default_factory=list)
    outside: Statements = field(default_factory=Statements)

    @property
    def columns(self) -> list[Column]:
        """The columns of its images table."""
        asked = [name for name in GROUP_COLUMNS if self.config.get(name) is not None]
        return [*TABLES["images"], *(column for name in asked for column in GROUP_COLUMNS[name])]

    @property
    def num_images(self) -> int:
        """All images of the run, on the page or not."""
        return len(self.verdicts)

    @property
    def config(self) -> Mapping[str, Any]:
        """The settings of the run."""
        config: Mapping[str, Any] = self.run.info["config"]
        return config


def read_content(run: RunReader, *, max_rows: int = MAX_ROWS) -> RunContent:
    """Read a run folder; memory grows with ``max_rows``, and by 100 bytes with every other image."""
    content = RunContent(run)
    columns = [column.name for column in content.columns]
    chunks: dict[str, list[FloatArray]] = {name: [] for name in DISTRIBUTIONS}
    worst: list[tuple[Any, int, Row]] = []
    for part, rows in run.parts("images", columns):
        for name, values in chunks.items():
            values.append(np.array([math.nan if row[name] is None else row[name] for row in rows], dtype=np.float64))
        for row in rows:
            _count(content, row)
            content.outside.add(row)
            row["part"] = part
        first = len(content.verdicts) - len(rows)
        keyed = [(severity(row), first + i, row) for i, row in enumerate(rows)]
        worst = heapq.nsmallest(max_rows, [*worst, *keyed]) if len(worst) + len(keyed) > max_rows else worst + keyed
    content.rows = [row for _, _, row in sorted(worst)]
    content.numbers = {name: np.concatenate([np.empty(0), *values]) for name, values in chunks.items()}
    _read_cameras(content)
    blank = dict.fromkeys(column.name for column in TABLES["models"])  # for columns that an older run does not have
    content.models = [blank | row for row in run.rows("models", list(blank))]
    return content


def severity(row: Row) -> tuple[Any, ...]:
    """Return a sort key: rejected first, then by severity, the largest misfit, the largest KS distance, and by name."""
    misfit, distance = (row[name] if row[name] is not None else 0.0 for name in ("misfit_px", "ks_stat"))
    where = natural_key(row["scene"], row["component"], row["image_name"])
    severity = SEVERITY_ORDER.get(row["severity"], len(SEVERITY_ORDER))
    return (VERDICT_ORDER.get(row["verdict"], 1), severity, -misfit, -distance, *where)


def _count(content: RunContent, row: Row) -> None:
    verdict = row["verdict"] or Verdict.UNDETERMINED
    content.verdicts.append(verdict)
    content.noise_model = content.noise_model or row["noise_model"]
    content.scenes[row["dataset"], row["scene"]][verdict] += 1
    for policy in POLICIES:
        content.counts[f"policy {policy}"][verdict_under(policy, row)] += 1
    for member in Member:
        if row[member] is not None:  # it was asked
            content.counts[member][row[member]] += 1
    details: dict[str, str] = {}
    for reason in reasons_of(row):
        details.setdefault(reason["code"], reason["text"])
    for code, detail in details.items():
        table = content.remarks if is_remark(code, row) else content.reasons
        if code in table:
            table[code].images += 1
        else:
            table[code] = Reason(1, row["image_name"], detail)


def _read_cameras(content: RunContent) -> None:
    columns = [column.name for column in TABLES["cameras"]]
    worst: list[tuple[Any, int, Row]] = []
    for part, rows in content.run.parts("cameras", columns):
        for row in rows:
            row["part"] = part
        keyed = [(_camera_severity(row), content.num_cameras + i, row) for i, row in enumerate(rows)]
        content.num_cameras += len(rows)
        worst = heapq.nsmallest(MAX_CAMERAS, [*worst, *keyed])
    content.cameras = [row for _, _, row in sorted(worst)]


def _camera_severity(row: Row) -> tuple[Any, ...]:
    return (-(row["misfit_px"] or 0.0), -row["num_images"], natural_key(row["scene"], row["camera_id"]))
