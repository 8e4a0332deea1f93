"""How does a gate look on GitHub? As a step summary: Markdown, under the 1 MiB that GitHub shows of one step."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from sfm_audit.reports.compare.gate import Check
from sfm_audit.reports.compare.gate_report import GateReport
from sfm_audit.reports.compare.keys import Noted
from sfm_audit.reports.text.wording import counted, plain

MAX_BYTES: Final = 1_000_000  # GitHub's limit is 1024 KiB, for all that one step writes
MAX_NAMES: Final = 20  # images listed per check and per kind of change
_RESERVED: Final = 200  # bytes for the line that says what was left out
_SPECIAL: Final = re.compile(r"([\\`*_{}\[\]()#+\-.!|~$@:])")


def text(value: str) -> str:
    """Return any text as Markdown that shows it on one line: no markup, no HTML, no mention, no link."""
    escaped = _SPECIAL.sub(r"\\\1", plain(value))
    return escaped.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def render_markdown(report: GateReport) -> str:
    """Return the report; what does not fit is counted and left to the JSON."""
    title = "passed" if report.passed else "failed"
    head = [f"## sfm\\-audit: {title}\n", f"\n{text(report.headline)}\n"]
    head += [f"\n> {text(note)}\n" for note in report.notes]
    return _fitted(head, [*_unread(report), *_checks(report.failed), *_failed_images(report.failed), *_changes(report)])


def _fitted(head: Sequence[str], blocks: Iterable[str]) -> str:
    """Join blocks up to the limit; blocks are whole lines, so nothing is cut inside a table row."""
    out, size, num_left_out = list(head), sum(len(block.encode()) for block in head), 0
    for block in blocks:
        size += len(block.encode())
        if num_left_out or size > MAX_BYTES - _RESERVED:
            num_left_out += 1
        else:
            out.append(block)
    if num_left_out:
        out.append(f"\n... and {counted(num_left_out, 'more line')}; all of them are in the file of --json\n")
    return "".join(out)


def _unread(report: GateReport) -> Iterator[str]:
    if report.unread:
        yield "\n### Inputs that could not be read\n\n"
        yield from (f"- {text(message)}\n" for _, message in report.unread)


def _checks(failed: Sequence[Check]) -> Iterator[str]:
    if failed:
        yield "\n### Failed checks\n\n| where | check | what |\n|---|---|---|\n"
        for check in failed:
            yield f"| {text(check.scope.name)} | {text(check.name)} | {text(check.message)} |\n"


def _failed_images(failed: Sequence[Check]) -> Iterator[str]:
    for check in failed:
        if check.images:
            yield f"\n**{text(check.scope.name)}, {text(check.name)}**\n\n"
            yield from _names(check.images)


def _changes(report: GateReport) -> Iterator[str]:
    """List what changed, failed or not."""
    if report.comparison is None:
        return
    change = report.comparison.whole
    yield "\n### Changes against the baseline\n\n| images | |\n|---|---:|\n"
    lists = {
        "newly rejected": change.newly_rejected,
        "fixed": change.fixed,
        "lost": change.lost,
        "added": change.added,
        "with another camera model": change.remodelled,
        "with a camera elsewhere": change.moved,
    }
    yield from (f"| {name} | {len(keys)} |\n" for name, keys in lists.items())
    for name, keys in lists.items():
        if keys:
            yield f"\n**{name}**\n\n"
            yield from _names(keys)


def _names(images: Noted) -> Iterator[str]:
    for key, remark in images[:MAX_NAMES]:
        yield f"- {text('/'.join(key))}{f' ({text(remark)})' if remark else ''}\n"
    if len(images) > MAX_NAMES:
        yield f"- ... and {len(images) - MAX_NAMES} more\n"
