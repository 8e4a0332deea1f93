"""scripts/release: what a changelog must say, and a dry run in a clone."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("release", ROOT / "scripts" / "release.py")
release = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(release)
TOP = "# Changelog\n\nFormat.\n\n"
OLD = "## [0.1.0] - 2026-01-02\n\n- first\n"
needs_git = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout")
needs_builder = pytest.mark.skipif(
    importlib.util.find_spec("hatchling") is None, reason="hatchling is not installed: the extra dev has it"
)


def test_sections_of_a_changelog():
    text = f"{TOP}## [Unreleased]\n\n### Added\n- new\n\n{OLD}"
    assert release.sections(text) == {"Unreleased": (None, "### Added\n- new"), "0.1.0": ("2026-01-02", "- first")}


@pytest.mark.parametrize(
    ("text", "dry", "ready"),
    [
        (f"## [0.2.0] - 2026-02-03\n\n- second\n\n{OLD}", None, None),
        (f"## [Unreleased]\n\n## [0.2.0] - 2026-02-03\n\n- second\n\n{OLD}", None, None),
        (f"## [Unreleased]\n\n- second\n\n{OLD}", None, "name the section"),
        ("## [Unreleased]\n\n- third\n\n## [0.2.0] - 2026-02-03\n\n- second\n", "part of it?", "part of it?"),
        (f"## [Unreleased]\n\n{OLD}", "says what changed", "says what changed"),
        (OLD, "says what changed", "says what changed"),
        (f"## [0.2.0]\n\n- second\n\n{OLD}", "no date", "no date"),
        (f"## [0.2.0] - 2026-02-03\n\n{OLD}", "says nothing", "says nothing"),
        (f"## [0.2.0] - unreleased\n\n- second\n\n{OLD}", "says what changed", "says what changed"),
    ],
)
def test_a_changelog_of_the_version(text, dry, ready):
    for expected, unreleased_is_fine in ((dry, True), (ready, False)):
        faults = release.changelog_faults(TOP + text, "0.2.0", unreleased_is_fine=unreleased_is_fine)
        assert len(faults) == (expected is not None)
        assert all(expected in fault for fault in faults)


def test_our_changelog_is_in_order():
    version = release.version_of((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert release.changelog_faults(changelog, version, unreleased_is_fine=True) == []


@pytest.fixture
def clone(tmp_path):
    folder = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", "--no-tags", str(ROOT), str(folder)], check=True)
    return folder


def dry_run(folder, **more):
    variables = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")} | more
    command = [sys.executable, str(folder / "scripts" / "release.py"), "--dry-run"]
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)


@needs_git
@needs_builder
def test_a_dry_run_builds_and_leaves_nothing(clone, quick_compiler):
    done = dry_run(clone, CC=quick_compiler)
    assert done.returncode == 0, done.stderr
    version = release.version_of((clone / "pyproject.toml").read_text(encoding="utf-8"))
    assert f"git tag -a v{version} -m 'sfm-audit {version}'" in done.stdout
    name = rf"sfm_audit-{re.escape(version)}"
    names = rf"{name}-py3-none-any\.whl, {name}-py3-none-\w+\.whl, {name}\.tar\.gz"
    assert re.search(rf"publish {names} from dist/", done.stdout)
    changed = subprocess.run(["git", "status", "--porcelain", "--ignored"], cwd=clone, capture_output=True, check=True)
    assert changed.stdout == b""


@needs_git
def test_a_dry_run_says_all_that_is_wrong(clone):
    version = release.version_of((clone / "pyproject.toml").read_text(encoding="utf-8"))
    (clone / "new.txt").write_text("new")
    (clone / "CHANGELOG.md").write_text("# Changelog\n")
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    subprocess.run(["git", *identity, "tag", "-a", f"v{version}", "-m", "taken"], cwd=clone, check=True)
    done = dry_run(clone)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.splitlines() == [
        "release: not committed: M CHANGELOG.md",
        "release: not committed: ?? new.txt",
        f"release: the tag v{version} exists: raise the version in pyproject.toml",
        f"release: CHANGELOG.md: neither [{version}] nor [Unreleased] says what changed",
    ]
