"""What does a gate's outcome hold, whatever file it is written to? And the JSON (docs/nightly.md)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sfm_audit.reports.compare.comparison import Comparison, ScopeChange
from sfm_audit.reports.compare.gate import Check
from sfm_audit.reports.compare.keys import Noted
from sfm_audit.reports.text.wording import counted

SHAPE: Final = 1  # of the JSON; raised when a key changes its meaning or goes


@dataclass(frozen=True, slots=True, eq=False)
class GateReport:
    """The outcome of one gate.

    run, baseline: folders as given.    unread: (location, message) of inputs that the run could not read.
    notes: lines that decide nothing.    timestamp: when, ISO 8601 without a time zone.
    """

    run: str
    baseline: str | None
    version: str
    timestamp: str
    checks: Sequence[Check]
    comparison: Comparison | None
    unread: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = ()

    @property
    def failed(self) -> list[Check]:
        """The checks that did not pass."""
        return [check for check in self.checks if not check.passed]

    @property
    def passed(self) -> bool:
        """Whether every check passed and every input was read."""
        return not self.failed and not self.unread

    @property
    def headline(self) -> str:
        """The outcome in one line."""
        against = f" against {self.baseline}" if self.baseline else ""
        if self.failed:
            outcome = f"{len(self.failed)} of {counted(len(self.checks), 'check')} failed"
        else:
            outcome = f"{counted(len(self.checks), 'check')} passed"
        unread = f", {counted(len(self.unread), 'input')} not read" if self.unread else ""
        return f"{self.run}{against}: {outcome}{unread}"


def render_json(report: GateReport) -> str:
    """Return the report as JSON, names exactly as stored."""
    content = {
        "shape": SHAPE,
        "tool": "sfm-audit",
        "version": report.version,
        "timestamp": report.timestamp,
        "run": report.run,
        "baseline": report.baseline,
        "passed": report.passed,
        "checks": [_check(check) for check in report.checks],
        "changes": _changes(report.comparison.whole) if report.comparison else None,
        "unread": [{"location": location, "message": message} for location, message in report.unread],
        "notes": list(report.notes),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _check(check: Check) -> dict[str, Any]:
    return {
        "dataset": check.scope.dataset,
        "scene": check.scope.scene,
        "check": check.name,
        "passed": check.passed,
        "value": check.value,
        "allowed": check.allowed,
        "message": check.message,
        "images": _images(check.images),
    }


def _changes(change: ScopeChange) -> dict[str, Any]:
    lists = {
        "lost": change.lost,
        "added": change.added,
        "newly_rejected": change.newly_rejected,
        "fixed": change.fixed,
        "camera_model_changed": change.remodelled,
        "moved": change.moved,
    }
    return {
        "scenes_lost": list(change.lost_scenes),
        "scenes_added": list(change.added_scenes),
        "models_lost": list(change.lost_models),
        **{name: _images(images) for name, images in lists.items()},
        "systematic_error_grown": [{**key._asdict(), "px": growth} for key, growth in change.grown_px],
    }


def _images(images: Noted) -> list[dict[str, str]]:
    return [{**key._asdict(), "remark": remark} for key, remark in images]
