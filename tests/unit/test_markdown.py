import re
from pathlib import Path

import pytest
from gate_samples import NASTY, rejected, scene, write_run

from sfm_audit.reports.compare.comparison import RunSnapshot, compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import GatePolicy
from sfm_audit.reports.compare.gate_report import GateReport
from sfm_audit.reports.compare.markdown import MAX_BYTES, render_markdown, text
from sfm_audit.reports.text.wording import plain


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)


def shown(markdown: str) -> str:
    """What a reader sees of escaped text: CommonMark's backslash escapes and HTML's three entities undone."""
    unescaped = re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", markdown)
    return unescaped.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")


def report(folder: Path, num_scenes: int, names=NASTY) -> GateReport:
    names = list(names)
    sound = scene(image_name=names)
    bad = rejected(sound, *range(len(names)))
    runs = [
        RunSnapshot.read(write_run(folder / name, {f"{i}": columns for i in range(num_scenes)}))
        for name, columns in (("R0", sound), ("R1", bad))
    ]
    comparison = compare(*runs)
    return GateReport("R1", "R0", "0.1.0", "2026-01-02T03:04:05", judge(GatePolicy(), runs[1], comparison), comparison)


@pytest.mark.parametrize("name", NASTY)
def test_a_name_is_text_on_one_line(name):
    escaped = text(name)
    assert "\n" not in escaped
    assert "<" not in escaped
    assert shown(escaped) == plain(name)
    assert not re.search(r"(?<!\\)[|`*_\[\]~$@]", escaped.replace("\\\\", ""))


def test_every_name_stands_in_a_line_of_its_own(tmp_path):
    lines = [shown(line) for line in render_markdown(report(tmp_path, 1)).splitlines()]
    for name in NASTY:
        assert any(line.startswith(f"- data/0/{plain(name)}") for line in lines)


def test_table_rows_have_three_cells(tmp_path):
    page = render_markdown(report(tmp_path, 1))
    rows = [line for line in page.split("### Changes")[0].splitlines() if line.startswith("|")]
    assert len(rows) > 2
    assert {len(re.split(r"(?<!\\)\|", row)) for row in rows} == {5}


def test_the_size_stays_below_what_github_shows(tmp_path, monkeypatch):
    monkeypatch.setattr("sfm_audit.reports.compare.markdown.MAX_BYTES", 20_000)
    page = render_markdown(report(tmp_path, 3, ["東" * 300 + f"{i}" for i in range(25)]))
    assert len(page.encode()) <= 20_000
    assert re.search(r"\.\.\. and \d+ more lines; all of them are in the file of --json\n$", page)
    assert MAX_BYTES < 1024 * 1024
