"""What is the matter, and what is to be done first? The diagnoses of a run's models, with the commands to copy."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from sfm_audit.audit.table.diagnoses import DiagnosisCode
from sfm_audit.audit.table.words import SEVERITY_ORDER
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.drawing import Page
from sfm_audit.reports.text.wording import counted, paragraph, plain, shorten

MAX_DIAGNOSES: Final = 8
TITLE: Final = "What to do, the most urgent first"
_ORDER: Final = {str(code): rank for rank, code in enumerate(DiagnosisCode)}
_RUN: Final = re.compile(r"(?<= )RUN(?= |$)")


def urgency(row: Row) -> Any:
    """Return a sort key of diagnoses: by their order, then by severity, then the most images."""
    severity = SEVERITY_ORDER.get(row["severity"], len(SEVERITY_ORDER))
    where = (row["dataset"], row["scene"], row["component"], row["model_path"])
    return (_ORDER.get(row["code"], len(_ORDER)), severity, -(row["num_images"] or 0), *where)


def triage_part(
    diagnoses: Sequence[Row], count: int, folder: Path, page: Page, where: Callable[[Row], str] | None
) -> list[str]:
    """Return the paragraph; none without a diagnosis.

    Parameters
    ----------
    diagnoses : the first of ``count``            folder : of the run, for the commands            where : how a model
        is called; None where there is one only
    """
    if not diagnoses:
        return []
    lines = [line for row in diagnoses for line in _lines(row, folder, page, where)]
    rest = [f"  ... and {count - len(diagnoses)} more, see diagnoses in RUN/models"]
    return ["\n".join([TITLE, *lines, *(rest if count > len(diagnoses) else [])])]


def _lines(row: Row, folder: Path, page: Page, where: Callable[[Row], str] | None) -> list[str]:
    place = "" if where is None else f"{shorten(where(row), 30)}: "
    such = f", such as {', '.join(shorten(plain(name), 30) for name in row['examples'])}" if row["examples"] else ""
    severity = f", {row['severity']}" if row["severity"] else ""
    whose = f"{counted(row['num_images'] or 0, 'image')}{severity}{such}"
    return [
        paragraph(f"- {place}{plain(row['text'] or '')} ({whose})", page.width, "  "),
        paragraph(f"  do: {plain(row['action'] or '')}", page.width, "    "),
        *command_lines(command_of(row, folder), page.width),
    ]


def command_of(row: Row, folder: Path) -> str:
    """Return the command of a diagnosis with the run folder in it, safe to print and to copy."""
    command = str(row["command"] or "")
    if command.startswith("sfm-audit "):
        command = _RUN.sub(lambda _: shlex.quote(str(folder)), command, count=1)
    return plain(command)


def command_lines(command: str, width: int) -> list[str]:
    """Return a command over several lines that a shell reads as one; a word longer than the line stays whole."""
    lines, room = [""], width - 6
    for word in command.split(" "):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > room:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".lstrip(" ")
    return [f"    {line} \\" for line in lines[:-1]] + [f"    {lines[-1]}"]
