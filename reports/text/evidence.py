"""What was found out about one model, for a terminal: its diagnoses, evidence, refits, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.triage import command_lines, command_of
from sfm_audit.reports.text.wording import counted, paragraph, plain


@dataclass(frozen=True, slots=True)
class EvidenceText:
    """Sentences: what the residuals say, what refits did (the control first), and what follows."""

    readings: Sequence[str]
    refits: Sequence[str]
    conclusion: str


def render_evidence(row: Row, text: EvidenceText, folder: Path, width: int) -> str:
    """Return all about the model in a row of ``RUN/models``; commands are not cut."""
    name = plain(f"{row['scene']}/{row['component']}")
    counts = ", ".join(f"{row[f'num_{verdict}']} {verdict}" for verdict in ("accepted", "rejected", "undetermined"))
    parts = [
        paragraph(f"{name} ({plain(row['model_path'])}): {counted(row['num_images'], 'image')}, {counts}", width, "  ")
    ]
    diagnoses = row.get("diagnoses") or []
    if diagnoses:
        lines = [line for each in diagnoses for line in _diagnosis_lines(each, folder, width)]
        parts.append("\n".join(["What is the matter", *lines]))
    for title, sentences in (
        ("What the residuals say", text.readings),
        ("What adjusting again does (pycolmap, principal points fixed)", text.refits),
        ("So", [text.conclusion]),
    ):
        if sentences:
            parts.append("\n".join([title, *(paragraph(f"- {plain(each)}", width, "  ") for each in sentences)]))
    return "\n\n".join(parts) + "\n"


def _diagnosis_lines(diagnosis: Row, folder: Path, width: int) -> list[str]:
    severity = f", {diagnosis['severity']}" if diagnosis["severity"] else ""
    whose = f"{counted(diagnosis['num_images'] or 0, 'image')}{severity}"
    command = command_of(diagnosis, folder)
    return [
        paragraph(f"- {plain(diagnosis['text'] or '')} ({whose})", width, "  "),
        *([] if " diagnose " in command else [paragraph(f"  do: {plain(diagnosis['action'] or '')}", width, "    ")]),
        *([] if " diagnose " in command else command_lines(command, width)),
    ]
