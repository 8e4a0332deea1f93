"""One section per code, of reasons and of findings: what terminal, page, docs and ``explain-code`` say about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sfm_audit.audit.table.guidance_findings import FINDING_GUIDANCE
from sfm_audit.audit.table.guidance_reasons import REASON_GUIDANCE, Guidance
from sfm_audit.audit.table.words import REASONS
from sfm_audit.loaders.model import FINDING_MEANINGS


@dataclass(frozen=True, slots=True)
class CodeSection:
    """All that is said of a code. kind: ``reason`` (of an image) or ``finding`` (of a model).

    makes: what it makes of the verdicts it speaks for, in words; empty for findings.
    """

    code: str
    kind: str
    meaning: str
    makes: str
    guidance: Guidance


def _reason_sections() -> list[CodeSection]:
    sections = []
    for code, words in REASONS.items():
        makes = "decides nothing" if words.makes is None else f"makes {', '.join(words.members)} {words.makes}"
        note = f" ({words.note})" if words.note else ""
        sections.append(CodeSection(str(code), "reason", words.meaning, makes + note, REASON_GUIDANCE[code]))
    return sections


SECTIONS: Final = (
    *_reason_sections(),
    *(
        CodeSection(str(code), "finding", meaning, "", FINDING_GUIDANCE[code])
        for code, meaning in FINDING_MEANINGS.items()
    ),
)
"""In the order of the two lists; a code that is a reason and a finding has a section of each kind."""


def sections_of(code: str) -> list[CodeSection]:
    """Return the sections of a code; none of an unknown one."""
    return [section for section in SECTIONS if section.code == code]
