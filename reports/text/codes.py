"""What does a code mean, and what is to be done? A section per code, for terminal and docs."""

from __future__ import annotations

from collections.abc import Iterable

from sfm_audit.audit.table.guidance import SECTIONS, CodeSection
from sfm_audit.reports.text.wording import paragraph


def render_sections(sections: Iterable[CodeSection], width: int) -> str:
    """Return sections as text, every line at most ``width`` wide."""
    return "\n\n".join(_section(section, width) for section in sections) + "\n"


def _section(section: CodeSection, width: int) -> str:
    whose = "a reason of an image" if section.kind == "reason" else "a finding of a model"
    lines = [f"{section.code}: {whose}{', ' + section.makes if section.makes else ''}"]
    for title, text in _parts(section):
        lines += [f"{title}: {text}"]
    return "\n".join(paragraph(line, width, "  ") for line in lines)


def _parts(section: CodeSection) -> tuple[tuple[str, str], ...]:
    guidance = section.guidance
    return (
        ("Meaning", section.meaning),
        ("Usual causes", guidance.causes),
        ("What to do", guidance.action),
        ("What not to conclude", guidance.caution),
    )


def codes_page() -> str:
    """Return the page with a section for every code, as Markdown."""
    out = [_PAGE]
    for kind, title in (("reason", "Reasons: of an image"), ("finding", "Findings: of a model")):
        out.append(f"## {title}\n")
        out += [_markdown(section) for section in SECTIONS if section.kind == kind]
    return "\n".join(out)


def _markdown(section: CodeSection) -> str:
    heading = section.code if section.kind == "reason" else f"{section.code} (finding)"
    made = f" It {section.makes}." if section.makes else ""
    first, *rest = _parts(section)
    lines = [f"### {heading}\n", f"{first[1][0].upper()}{first[1][1:]}.{made}\n"]
    lines += [f"- **{title}**: {text}" for title, text in rest]
    return "\n".join(lines) + "\n"


_PAGE = """# What a code means, and what to do

Made from `audit/table/guidance_reasons.py` and `audit/table/guidance_findings.py` by `scripts/make_docs_tables.py`; do
not edit. `sfm-audit explain-code CODE` prints a section, without a code the list of all.
"""
