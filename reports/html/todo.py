"""What to do about the models, and what the codes on the page mean."""

from __future__ import annotations

import heapq
from typing import Any, Final

from sfm_audit.audit.table.guidance import SECTIONS, CodeSection
from sfm_audit.reports.html.content import RunContent
from sfm_audit.reports.text.triage import command_of, urgency
from sfm_audit.reports.text.wording import plain

MAX_DIAGNOSES: Final = 40
_LABELS: Final = ("dataset", "scene", "component", "model_path")


def diagnoses_of(content: RunContent) -> tuple[list[dict[str, Any]], int]:
    """Return the most urgent diagnoses of the run's models, as the page shows them, and how many there are."""
    found = [
        {**diagnosis, **{name: model[name] for name in _LABELS}}
        for model in content.models
        for diagnosis in model["diagnoses"] or []
    ]
    shown = heapq.nsmallest(MAX_DIAGNOSES, found, key=urgency)
    return [
        {
            "code": plain(str(row["code"])),
            "place": plain(f"{row['scene']}/{row['component']}"),
            "text": plain(row["text"] or ""),
            "action": plain(row["action"] or ""),
            "command": command_of(row, content.run.folder),
            "images": row["num_images"] or 0,
            "severity": row["severity"],
            "examples": [plain(name) for name in row["examples"] or []],
        }
        for row in shown
    ], len(found)


def codes_of(content: RunContent) -> list[CodeSection]:
    """Return the sections of the reasons, remarks and findings that the run has, in the order of the docs."""
    findings = {finding["code"] for model in content.models for finding in model["findings"] or []}
    used = {"reason": {*content.reasons, *content.remarks}, "finding": findings}
    return [section for section in SECTIONS if section.code in used[section.kind]]
