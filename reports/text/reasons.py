"""Why are images not accepted, what is only remarked, and which camera models are advised? Counted over a run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from sfm_audit.audit.table.words import Member, Verdict, is_remark
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.wording import counted, paragraph, plain, shorten

REASON_COLUMNS: Final = ("image_name", str(Member.MISFIT), "advised_camera_model", "reasons")
MAX_ADVICE: Final = 3
_REASONS_TITLE: Final = "Why images are not accepted (what to do: sfm-audit explain-code CODE)"


def reasons_of(row: Row) -> list[Row]:
    """Return the reasons in a row of the images table as records: those of its verdict, in their order.

    A run of an older version has no column ``reason_details``; its reasons then are a code and a text.
    """
    details = {f"{item['code']}: {item['text']}": item for item in reversed(row.get("reason_details") or [])}
    return [details[said] if said in details else _undetailed(said) for said in row["reasons"] or []]


def _undetailed(said: str) -> Row:
    code, _, text = said.partition(":")
    empty = dict.fromkeys(("verdict", "value", "limit", "unit", "group"))
    return {**empty, "code": code, "text": text.strip()}


@dataclass(slots=True)
class _Count:
    """Images per code, and the first image of each code with its detail."""

    images: Counter[str] = field(default_factory=Counter)
    examples: dict[str, tuple[str, str]] = field(default_factory=dict)

    def add(self, code: str, detail: str, image_name: str) -> None:
        self.images[code] += 1
        self.examples.setdefault(code, (image_name, detail))

    def lines(self, width: int) -> list[str]:
        return [self._line(code, width) for code, _ in self.images.most_common()]

    def _line(self, code: str, width: int) -> str:
        name, detail = self.examples[code]
        such = "such as " if self.images[code] > 1 else ""
        where = ": ".join(part for part in (shorten(plain(name), 30), plain(detail)) if part)
        return paragraph(f"  {code}  {counted(self.images[code], 'image')}, {such}{where}", width, "    ")


def reasons_part(run: RunReader, width: int) -> list[str]:
    """Return the paragraphs: reasons, remarks, advice; those that have nothing to say are left out."""
    reasons, remarks = _Count(), _Count()
    fixing: Counter[str] = Counter()
    simpler: Counter[str] = Counter()
    for row in run.rows("images", REASON_COLUMNS):
        details: dict[str, str] = {}
        for reason in reasons_of(row):
            details.setdefault(reason["code"], reason["text"])  # two verdicts may give one code; it counts once
        for code, detail in details.items():
            (remarks if is_remark(code, row) else reasons).add(code, detail, row["image_name"])
        if row["advised_camera_model"] is not None:
            (fixing if row[Member.MISFIT] == Verdict.REJECTED else simpler)[row["advised_camera_model"]] += 1
    advice = [
        *_advice("with a misfit that matters", fixing, width),
        *_advice("where less would do", simpler, width),
    ]
    parts = [
        (
            paragraph("Why images are not accepted (what to do: sfm-audit explain-code CODE)", width),
            reasons.lines(width),
        ),
        ("Remarks (decide nothing)", remarks.lines(width)),
        ("Advised camera models", advice),
    ]
    return ["\n".join([title, *lines]) for title, lines in parts if lines]


def _advice(whose: str, counts: Counter[str], width: int) -> list[str]:
    """Return one line: the most frequent advice; none where there is none."""
    if not counts:
        return []
    most = counts.most_common(MAX_ADVICE)
    rest = counts.total() - sum(count for _, count in most)
    shown = ", ".join(f"{plain(advice)} ({count})" for advice, count in [*most, *([("others", rest)] if rest else [])])
    return [paragraph(f"  {counted(counts.total(), 'image')} {whose}: {shown}", width, "    ")]
