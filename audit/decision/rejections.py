"""Which rejections count? Those for some reasons, those that are severe enough; the others leave their image open.

A witness that may not reject of itself does where it is named: whoever names it trusts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sfm_audit.audit.table.words import (
    REASONS,
    SEVERITY_ORDER,
    WITNESS_CODES,
    Member,
    ReasonCode,
    Severity,
    Verdict,
)

if TYPE_CHECKING:
    import pyarrow as pa

REJECTING_CODES: Final = tuple(code for code, words in REASONS.items() if words.makes is Verdict.REJECTED)
"""Reasons that can reject an image."""
NAMEABLE_CODES: Final = tuple(dict.fromkeys((*REJECTING_CODES, *WITNESS_CODES.values())))
"""Reasons that reject an image, of itself or where they are named."""
_BY_NAME: Final = frozenset(NAMEABLE_CODES) - frozenset(REJECTING_CODES)


@dataclass(frozen=True, slots=True)
class CountedRejections:
    """Which rejections count.

    reasons: those that have one of these among the reasons of the policy; all where it is empty. Codes of witnesses
        among them reject what they leave undetermined of themselves, as long as no severity is asked for.
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
        by_name = " or ".join(sorted(self._by_name))
        also = f"; {by_name} rejects what it leaves open of itself" if by_name else ""
        return f"only rejections {' and '.join(said)} count, others are undetermined{also}" if said else ""

    @property
    def _by_name(self) -> frozenset[ReasonCode]:
        """The reasons that reject because they are named; none has a severity."""
        return self.reasons & _BY_NAME if self.at_least is None else frozenset()

    def verdict(self, row: Mapping[str, Any]) -> str | None:
        """Return the verdict of an image by the columns ``verdict``, ``severity`` and ``reasons`` of its row."""
        verdict: str | None = row["verdict"]
        if verdict == Verdict.UNDETERMINED and self._by_name & _codes(row):
            return Verdict.REJECTED
        return verdict if verdict != Verdict.REJECTED or self._counts(row) else Verdict.UNDETERMINED

    def _counts(self, row: Mapping[str, Any]) -> bool:
        if self.reasons and not self.reasons & _codes(row):
            return False
        severities = set(Severity)
        if self.at_least is None:
            return True
        return row["severity"] in severities and SEVERITY_ORDER[row["severity"]] <= SEVERITY_ORDER[self.at_least]


def _codes(row: Mapping[str, Any]) -> set[str]:
    return {said.partition(":")[0] for said in row["reasons"] or ()}


def counted(images: pa.Table, rule: CountedRejections) -> pa.Table:
    """Return the images table of a run with ``verdict`` undetermined where a rejection does not count.

    Rejected where a witness speaks against an image that does not reject unless it is named.

    Undetermined and not accepted: nobody said that such an image is right. Its reasons and member verdicts stay.
    """
    if not rule:
        return images
    import pyarrow as pa  # noqa: PLC0415 - who audits imports this file, and calls nothing of it

    rows = images.select(["verdict", "severity", "reasons"]).to_pylist()
    at = images.column_names.index("verdict")
    fresh = pa.array([rule.verdict(row) for row in rows], type=images.schema.field(at).type)
    return images.set_column(at, images.schema.field(at), fresh)


def verdict_counts(images: pa.Table) -> dict[str, int]:
    """Return the columns num_<verdict>[_<member>] of the models table, counted over the images of one model."""
    columns = {"": "verdict", **{f"_{member.short}": str(member) for member in Member}}
    said = {suffix: images.column(name).to_pylist() for suffix, name in columns.items()}
    return {f"num_{verdict}{suffix}": words.count(verdict) for suffix, words in said.items() for verdict in Verdict}
