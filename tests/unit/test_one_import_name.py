"""Installing occupies one import name: nothing here or in the product imports the rooms by their folder's names.

What is installed, and every verb among a user's modules of those names: tests/e2e/test_installed.py.
"""

import importlib.metadata
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sfm_audit

ROOT = Path(__file__).parents[2]
IN_STRINGS = re.compile(r"(?:files|Loader|import_module|find_spec)\(\s*f?[\"'](audit|loaders|reports)\b")
OLD = re.compile(r"(?:^|[\s\"';])(?:from|import)\s+(audit|loaders|reports)(?=[.\s;\"']|$)", re.MULTILINE)
FILES = sorted(
    path for folder in ("audit", "loaders", "reports", "scripts", "tests") for path in (ROOT / folder).rglob("*.py")
)


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(ROOT)) for path in FILES])
def test_rooms_are_imported_through_the_package(path):
    if path == Path(__file__):
        return
    text = path.read_text(encoding="utf-8")
    assert not OLD.findall(text)
    assert not IN_STRINGS.findall(text)


def test_the_pattern_finds_what_it_should():
    assert OLD.findall("from audit.x import y") == ["audit"]
    assert OLD.findall("code = 'import loaders'") == ["loaders"]
    assert not OLD.findall("from sfm_audit.audit import x\nimport audit_stubs")
    assert IN_STRINGS.findall('resources.files("reports.html")') == ["reports"]
    assert IN_STRINGS.findall('PackageLoader("reports")') == ["reports"]
    assert not IN_STRINGS.findall('files("sfm_audit.reports.html")\nread_files("auditors")')


def test_a_checkout_without_links_says_what_to_do(tmp_path):
    """Where Git makes no links (core.symlinks false), it writes files that hold the link's target."""
    package = tmp_path / "sfm_audit"
    package.mkdir()
    shutil.copy(sfm_audit.__file__, package)
    for room in ("audit", "loaders", "reports"):
        (package / room).write_text(f"../{room}")
    for code in ("import sfm_audit", "from sfm_audit import open_model", "import sfm_audit.loaders.model"):
        command = [sys.executable, "-S", "-c", code]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert done.stderr.splitlines()[-1].startswith("ImportError: sfm_audit: its folders audit, loaders and reports")
        assert "git config core.symlinks true && git checkout -- sfm_audit" in done.stderr


def test_the_links_are_links_and_relative():
    for room in ("audit", "loaders", "reports"):
        link = ROOT / "sfm_audit" / room
        assert link.readlink() == Path("..") / room


def test_the_version_stands_in_one_place():
    assert sfm_audit.__version__ == importlib.metadata.version("sfm-audit")
    assert "__version__" in dir(sfm_audit)
    literal = re.compile(r"""["']\d+\.\d+\.\d+["']""")
    product = [path for path in FILES if path.relative_to(ROOT).parts[0] in ("audit", "loaders", "reports")]
    assert [path for path in product if literal.search(path.read_text("utf-8"))] == []


def test_every_public_name_is_there():
    for name in sfm_audit.__all__:
        assert getattr(sfm_audit, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'audit_everything'"):
        _ = sfm_audit.audit_everything
