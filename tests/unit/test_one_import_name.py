"""Installing occupies one import name: nothing here or in the product imports the rooms by their folder's names."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OLD = re.compile(r"(?:^|[\s\"';])(?:from|import)\s+(audit|loaders|reports)(?=[.\s;\"']|$)", re.MULTILINE)
FILES = sorted(
    path for folder in ("audit", "loaders", "reports", "scripts", "tests") for path in (ROOT / folder).rglob("*.py")
)


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(ROOT)) for path in FILES])
def test_rooms_are_imported_through_the_package(path):
    if path == Path(__file__):
        return
    assert not OLD.findall(path.read_text(encoding="utf-8"))


def test_the_pattern_finds_what_it_should():
    assert OLD.findall("from audit.x import y") == ["audit"]
    assert OLD.findall("code = 'import loaders'") == ["loaders"]
    assert not OLD.findall("from sfm_audit.audit import x\nimport audit_stubs")
