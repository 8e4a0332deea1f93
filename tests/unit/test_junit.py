"""JUnit XML as Jenkins and GitLab read it.

The schemas' rules that matter are repeated here; on 2026-11-22 the output of the samples below was also validated with
xmlschema 4.3 against windyroad/JUnit-Schema JUnit.xsd and the xUnit plugin's junit-10.xsd, which are not ours to copy.
"""

import json
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from gate_samples import NASTY, rejected, scene, write_run

from sfm_audit.reports.compare.comparison import RunSnapshot, compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import GatePolicy
from sfm_audit.reports.compare.gate_report import GateReport, render_json
from sfm_audit.reports.compare.junit import MAX_NAMES, render_junit
from sfm_audit.reports.text.wording import plain

SUITE = {"name", "package", "id", "timestamp", "hostname", "time", "tests", "failures", "errors"}


def report(folder: Path, names=NASTY, unread=(), notes=()) -> GateReport:
    names = list(names)
    before = RunSnapshot.read(write_run(folder / "R0", {"a\nb": scene(image_name=names), "c.d": scene(4)}))
    after = rejected(scene(image_name=names), *range(len(names)), reason="ks_rejected: <b>\x00</b>")
    run = RunSnapshot.read(write_run(folder / "R1", {"a\nb": after, "c.d": scene(4)}))
    comparison = compare(before, run)
    checks = judge(GatePolicy(), run, comparison)
    return GateReport("R1", "R0", "0.1.0", "2026-01-02T03:04:05", checks, comparison, unread, notes)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)


def parsed(content: bytes) -> ET.Element:
    return ET.fromstring(content)  # noqa: S314  # our own file


def assert_valid(root: ET.Element) -> None:
    assert root.tag == "testsuites"
    assert root.attrib == {}
    assert [suite.get("id") for suite in root] == [str(i) for i in range(len(root))]
    for suite in root:
        assert suite.tag == "testsuite"
        assert set(suite.attrib) == SUITE
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d", suite.attrib["timestamp"])
        assert suite.attrib["name"]
        tags = [child.tag for child in suite]
        cases = suite.findall("testcase")
        assert tags == ["properties", *["testcase"] * len(cases), "system-out", "system-err"]
        assert suite.get("tests") == str(len(cases))
        for tag, count in (("failure", "failures"), ("error", "errors")):
            assert suite.get(count) == str(len(suite.findall(f"testcase/{tag}")))
        for case in cases:
            assert set(case.attrib) == {"name", "classname", "time"}
            assert all(case.attrib.values())
            assert len(case) <= 1
            for outcome in case:
                assert outcome.tag in {"failure", "error"}
                assert set(outcome.attrib) == {"type", "message"}


def test_it_is_valid_and_names_are_text(tmp_path):
    content = render_junit(report(tmp_path, unread=[("data/x", "data/x: byte 7 \x01")], notes=["a note"]))
    root = parsed(content)
    assert_valid(root)
    [failure] = root.findall("testsuite[@name='data/a\\nb']/testcase[@name='band.newly_rejected']/failure")
    lines = (failure.text or "").split("\n")[1:]
    assert sorted(lines) == sorted(plain(f"data/a\nb/{name} ks_rejected: <b>\x00</b>") for name in NASTY)
    assert root.findall("testsuite[@name='inputs']/testcase/error")
    assert "תמונה של מגדל".encode() in content


def test_a_check_that_passes_is_a_case_without_outcome(tmp_path):
    root = parsed(render_junit(report(tmp_path)))
    cases = root.findall("testsuite[@name='data/c.d']/testcase")
    assert len(cases) == 12
    assert all(len(case) == 0 for case in cases)
    assert {case.get("classname") for case in cases} == {"sfm-audit.data/c_d"}


def test_long_lists_are_cut_and_say_so(tmp_path):
    names = [f"{i}.jpg" for i in range(MAX_NAMES + 7)]
    root = parsed(render_junit(report(tmp_path, names)))
    assert_valid(root)
    assert "... and 7 more, see --json" in ET.tostring(root, encoding="unicode")


def test_without_checks_it_is_still_a_document():
    nothing = GateReport("R", None, "0.1.0", "2026-01-02T03:04:05", [], None)
    assert_valid(parsed(render_junit(nothing)))


def test_json_has_names_as_stored(tmp_path):
    text = render_json(report(tmp_path))
    content = json.loads(text)
    assert {image["image_name"] for image in content["changes"]["newly_rejected"]} == set(NASTY)
    assert content["shape"] == 1
    assert not content["passed"]
