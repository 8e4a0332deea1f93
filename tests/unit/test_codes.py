"""Every reason and finding has a section, and terminal, docs and command say the same."""

import re

import pytest

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.table.guidance import SECTIONS, sections_of
from sfm_audit.audit.table.words import ReasonCode
from sfm_audit.loaders.model import FindingCode
from sfm_audit.reports.text.codes import codes_page, render_sections


def test_every_code_has_a_section_of_its_own():
    said = [(section.kind, section.code) for section in SECTIONS]
    assert len(said) == len(set(said))
    assert set(said) == {*(("reason", code) for code in ReasonCode), *(("finding", code) for code in FindingCode)}
    parts = [(s.guidance.causes, s.guidance.action, s.guidance.caution) for s in SECTIONS if s.kind == "reason"]
    assert len(set(parts)) == len(parts)
    assert all(text.endswith(".") and text[0].isupper() for part in parts for text in part)


def test_a_code_of_both_kinds_is_told_as_both():
    assert [section.kind for section in sections_of("points_behind")] == ["reason", "finding"]
    assert sections_of("nothing") == []


@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_line_is_wider_than_the_terminal(width):
    text = render_sections(SECTIONS, width)
    assert max(map(len, text.splitlines())) <= width
    assert text.count("What not to conclude:") == len(SECTIONS)


def test_the_page_has_an_anchor_that_the_tables_lead_to():
    headings = re.findall(r"^### (.+)$", codes_page(), flags=re.MULTILINE)
    assert headings == [s.code if s.kind == "reason" else f"{s.code} (finding)" for s in SECTIONS]


def test_explain_code_prints_a_section(capsys):
    assert main(["explain-code", "misfit_radial"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    words = " ".join(out.split())
    assert "makes verdict_misfit rejected" in words
    assert "SIMPLE_RADIAL to RADIAL" in words
    assert main(["explain-code"]) == 0
    assert all(code in capsys.readouterr().out for code in ("rounded_poses",))


def test_a_misspelt_code_is_2_and_told_what_was_meant(capsys):
    assert main(["explain-code", "misfit_radail"]) == 2
    assert "did you mean misfit_radial?" in capsys.readouterr().err
    assert main(["explain-code", "???"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
