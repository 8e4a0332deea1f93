"""Which rejections count? Those for some reasons, those that are severe enough; the others leave their image open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa

from sfm_audit.audit.table.words import (
    REASONS,
    SEVERITY_ORDER,
    Member,
    ReasonCode,
    Severity,
    Verdict,
)

REJECTING_CODES: Final = tuple(code for code, words in REASONS.items() if words.makes is Verdict.REJECTED)
"""Reasons that can reject an image."""


@dataclass(frozen=True, slots=True)
class CountedRejections:
    """Which rejections count.

    reasons: those that have one of these among the reasons of the policy; all where it is empty.
    at_least: those of this severity or a worse one; None for all.
    """

    reasons: frozenset[ReasonCode] = frozenset()
    at_least: Severity | None = None

    def __bool__(self) -> bool:
        return bool(self.reasons) or self.at_least is not None

    def __str__(self) -> str:
        """The rule in words; empty where all rejections count."""
        said = []
        if self.reasons:
            said.append(f"for {' or '.join(sorted(self.reasons))}")
        if self.at_least is not None:
            worse = "" if self.at_least is Severity.HARD else " or worse"
            said.append(f"of severity {self.at_least}{worse}")
        return f"only rejections {' and '.join(said)} count, others are undetermined" if said else ""

    def verdict(self, row: Mapping[str, Any]) -> str | None:
        """Return the verdict of an image by the columns ``verdict``, ``severity`` and ``reasons`` of its row."""
        if row["verdict"] != Verdict.REJECTED or self._counts(row):
            verdict: str | None = row["verdict"]
            return verdict
        return Verdict.UNDETERMINED

    def _counts(self, row: Mapping[str, Any]) -> bool:
        codes = {said.partition(":")[0] for said in row["reasons"] or ()}
        if self.reasons and not self.reasons & codes:
            return False
        severities = set(Severity)
        if self.at_least is None:
            return True
        return row["severity"] in severities and SEVERITY_ORDER[row["severity"]] <= SEVERITY_ORDER[self.at_least]


def counted(images: pa.Table, rule: CountedRejections) -> pa.Table:
    """Return the images table of a run with ``verdict`` undetermined where a rejection does not count.

    Undetermined and not accepted: nobody said that such an image is right. Its reasons and member verdicts stay.
    """
    if not rule:
        return images
    rows = images.select(["verdict", "severity", "reasons"]).to_pylist()
    at = images.column_names.index("verdict")
    fresh = pa.array([rule.verdict(row) for row in rows], type=images.schema.field(at).type)
    return images.set_column(at, images.schema.field(at), fresh)


def verdict_counts(images: pa.Table) -> dict[str, int]:
    """Return the columns num_<verdict>[_<member>] of the models table, counted over the images of one model."""
    columns = {"": "verdict", **{f"_{member.short}": str(member) for member in Member}}
    said = {suffix: images.column(name).to_pylist() for suffix, name in columns.items()}
    return {f"num_{verdict}{suffix}": words.count(verdict) for suffix, words in said.items() for verdict in Verdict}
