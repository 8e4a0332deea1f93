"""The page of diff: what the comparison says, hostile names as text."""

import json
import re

import numpy as np
import pytest
from report_samples import NASTY_NAMES, write_run

from sfm_audit.audit.cli.main import main
from sfm_audit.reports.html.diff import NOT_THERE


@pytest.fixture(autouse=True)
def no_flush(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "A", 30, names=NASTY_NAMES[:4])
    write_run(tmp_path / "B", 28, names=NASTY_NAMES[:4], seed=3)
    return tmp_path


def payload(text):
    found = re.search(r'<script type="application/json" id="payload">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])["rows"]


def test_the_page_holds_every_change_and_the_moves_add_up(runs, capsys):
    assert main(["diff", "A", "B", "--html", "d.html"]) == 0
    assert "sfm-audit diff: B against A" in capsys.readouterr().out
    text = (runs / "d.html").read_text()
    rows = payload(text)
    lost = [row for row in rows if "lost" in row[2]]
    assert len(lost) == 2
    assert all(row[4] == NOT_THERE for row in lost)
    assert {"newly rejected", "fixed"} <= {kind for row in rows for kind in row[2]}
    for row in rows:
        assert row[3] != row[4] or set(row[2]) & {"larger systematic error", "another camera model", "moved"}
    table = re.search(r"Images by verdict before.*?</table>", text, re.DOTALL)[0]
    counts = np.array([int(n) for n in re.findall(r'<td class="n">(\d+)</td>', table)]).reshape(4, 4)
    assert counts.sum() == 30
    assert counts[:, 3].sum() == 2


def test_names_are_text(runs):
    assert main(["diff", "A", "B", "--html", "d.html"]) == 0
    text = (runs / "d.html").read_text()
    around = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)  # without our own scripts
    assert around.count("<script") == 1
    assert "<img" not in around
    assert NASTY_NAMES[0] not in text


def test_a_page_is_not_replaced_without_asking(runs, capsys):
    (runs / "d.html").write_text("mine")
    assert main(["diff", "A", "B", "--html", "d.html"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert (runs / "d.html").read_text() == "mine"
    assert main(["diff", "A", "B", "--html", "d.html", "--force"]) == 0
    assert main(["diff", "A", "B", "--html", "d.html/d.html"]) == 4


def test_equal_runs(runs):
    assert main(["diff", "A", "A", "--html", "d.html"]) == 0
    text = (runs / "d.html").read_text()
    assert payload(text) == []
    assert "0 images of 30 changed" in text
