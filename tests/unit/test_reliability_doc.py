"""docs/reliability.md promises nothing without naming a test that tried to break it, and names no test that is not."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NAMED = re.compile(r"`((?:[\w/]*test_\w+\.py)?(?:::\w+)?)`")


def rows():
    """Cells that say what proves a promise, with the line of the file; of tables whose head says that they do."""
    proves, found = False, []
    for number, line in enumerate((ROOT / "docs/reliability.md").read_text(encoding="utf-8").splitlines(), 1):
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            proves = False
        elif cells[-1] in {"proved by", "measured"}:
            proves = True
        elif proves and not set(cells[-1]) <= {"-"}:
            found.append(pytest.param(cells[-1], id=f"line {number}"))
    return found


def functions_of(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


def named_tests(cell):
    """Files and functions that a cell names; `::function` alone is of the file before it."""
    file = ""
    for name in filter(None, NAMED.findall(cell)):
        own, _, function = name.partition("::")
        file = own or file
        yield file, function


def stresses():
    tree = ast.parse((ROOT / "scripts/stress.py").read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")}


@pytest.mark.parametrize("cell", rows())
def test_a_promise_names_tests_that_are_there(cell):
    named = list(named_tests(cell))
    measured = re.findall(r"--only (\w+)", cell)
    assert named or measured
    assert set(measured) <= stresses()
    for file, function in named:
        paths = [path for path in (ROOT / "tests").rglob(Path(file).name) if path.as_posix().endswith(f"/{file}")]
        assert len(paths) == 1, file
        assert not function or function in functions_of(paths[0]), f"{file}::{function}"


def test_all_tables_but_the_threat_model_are_asked():
    text = (ROOT / "docs/reliability.md").read_text(encoding="utf-8")
    assert len(rows()) > 35
    assert text.count("| proved by |") + text.count("| measured |") == text.count("|---|---|") - 1


def test_a_function_alone_is_of_the_file_before_it():
    assert list(named_tests("`tests/unit/test_a.py::test_b`, `::test_c` and `test_d.py`")) == [
        ("tests/unit/test_a.py", "test_b"),
        ("tests/unit/test_a.py", "test_c"),
        ("test_d.py", ""),
    ]
