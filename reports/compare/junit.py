"""How do Jenkins and GitLab read a gate? As JUnit XML: a suite per scope, a test case per check.

There is no official schema. What is written here is valid under both that tools refer to: the strict one of the Ant
task (windyroad/JUnit-Schema, every attribute it requires and none it does not know) and junit-10.xsd of Jenkins' xUnit
plugin. GitLab reads a subset of both.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import Final
from xml.etree import ElementTree as ET

from sfm_audit.reports.compare.gate import Check
from sfm_audit.reports.compare.gate_report import GateReport
from sfm_audit.reports.compare.keys import Scope
from sfm_audit.reports.text.wording import plain

MAX_NAMES: Final = 200  # images listed per failed check; all are in the JSON
TOOL: Final = "sfm-audit"


def render_junit(report: GateReport) -> bytes:
    """Return the report as UTF-8 XML; names are text, control characters in them shown by their codes."""
    root = ET.Element("testsuites")
    for scope, checks in groupby(report.checks, key=lambda check: check.scope):
        suite = _suite(root, scope.name, report)
        for check in checks:
            _case(suite, check)
        _close(suite, report)
    if report.unread or not report.checks:
        suite = _suite(root, "inputs", report)
        for location, message in report.unread:
            case = _test_case(suite, location, f"{TOOL}.inputs")
            _outcome(case, "error", "unread", message, [])
        _close(suite, report)
    ET.indent(root, " ")
    text: str = ET.tostring(root, encoding="unicode")
    return f"<?xml version='1.0' encoding='utf-8'?>\n{text}\n".encode()


def _suite(root: ET.Element, name: str, report: GateReport) -> ET.Element:
    suite = ET.SubElement(root, "testsuite")
    attributes = {"name": _name(name), "package": TOOL, "id": str(len(root) - 1), "timestamp": report.timestamp}
    for key, value in {**attributes, "hostname": "localhost", "time": "0"}.items():
        suite.set(key, value)
    properties = ET.SubElement(suite, "properties")
    for key, value in (("run", report.run), ("baseline", report.baseline or ""), ("version", report.version)):
        ET.SubElement(properties, "property", name=key, value=plain(value))
    return suite


def _close(suite: ET.Element, report: GateReport) -> None:
    """Complete a suite whose cases are known."""
    for key, tag in (("tests", "testcase"), ("failures", "testcase/failure"), ("errors", "testcase/error")):
        suite.set(key, str(len(suite.findall(tag))))
    ET.SubElement(suite, "system-out").text = "\n".join(plain(note) for note in report.notes)
    ET.SubElement(suite, "system-err")


def _case(suite: ET.Element, check: Check) -> None:
    case = _test_case(suite, check.name, _class_name(check.scope))
    if not check.passed:
        _outcome(case, "failure", check.name, check.message, _image_lines(check))


def _test_case(suite: ET.Element, name: str, class_name: str) -> ET.Element:
    return ET.SubElement(suite, "testcase", name=_name(name), classname=_name(class_name), time="0")


def _outcome(case: ET.Element, tag: str, kind: str, message: str, lines: Iterable[str]) -> None:
    element = ET.SubElement(case, tag, type=kind, message=plain(message))
    element.text = "\n".join([plain(message), *lines])


def _image_lines(check: Check) -> list[str]:
    lines = [plain(" ".join(filter(None, ("/".join(key), remark)))) for key, remark in check.images[:MAX_NAMES]]
    more = len(check.images) - MAX_NAMES
    return [*lines, f"... and {more} more, see --json"] if more > 0 else lines


def _class_name(scope: Scope) -> str:
    """Tools split class names at dots into packages: a scene's own dots are no packages."""
    return f"{TOOL}.{scope.name.replace('.', '_')}"


def _name(text: str) -> str:
    """A token that is not empty: the schema's names have no space at their ends and no two in a row."""
    return " ".join(plain(text).split()) or "-"
