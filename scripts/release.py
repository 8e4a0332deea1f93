"""Make a release ready: check, build the wheels and the sdist into dist/, print the commands that tag it.

Two wheels: one with compiled kernels for this platform, for which a C compiler is needed here, and one for any other.
Nothing is tagged, pushed or uploaded. With --dry-run nothing is written either, and the changes may still stand under
"Unreleased". All that is wrong is said at once.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
_HEADING: Final = re.compile(r"^## \[([^\]]+)\](?: - (\d{4}-\d{2}-\d{2}))?[ \t]*$", re.MULTILINE)
_VERSION: Final = re.compile(r"\d+\.\d+\.\d+(?:(?:a|b|rc)\d+)?")


def version_of(pyproject: str) -> str:
    """Return the version that pyproject.toml states, the only place where it stands."""
    return str(tomllib.loads(pyproject)["project"]["version"])


def sections(changelog: str) -> dict[str, tuple[str | None, str]]:
    """Return the sections of a changelog in the format of Keep a Changelog: version to date and text."""
    found = list(_HEADING.finditer(changelog))
    ends = [*(heading.start() for heading in found[1:]), len(changelog)][: len(found)]
    return {
        heading[1]: (heading[2], changelog[heading.end() : end].strip())
        for heading, end in zip(found, ends, strict=True)
    }


def changelog_faults(changelog: str, version: str, *, unreleased_is_fine: bool) -> list[str]:
    """Say what keeps this changelog from being the one of ``version``."""
    found = sections(changelog)
    date, text = found.get(version, (None, ""))
    if version in found:
        faults = [] if date else [f"CHANGELOG.md: [{version}] has no date: ## [{version}] - YYYY-MM-DD"]
        faults += [] if text else [f"CHANGELOG.md: [{version}] says nothing"]
        if found.get("Unreleased", (None, ""))[1]:
            faults.append(f"CHANGELOG.md: [Unreleased] holds changes beside [{version}]; are they part of it?")
        return faults
    if not found.get("Unreleased", (None, ""))[1]:
        return [f"CHANGELOG.md: neither [{version}] nor [Unreleased] says what changed"]
    return [] if unreleased_is_fine else [f"CHANGELOG.md: name the section [Unreleased] [{version}] - YYYY-MM-DD"]


def git(*arguments: str) -> str:
    """Return what Git says."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def tree_faults(tag: str) -> list[str]:
    """Say what is not committed, and whether the tag is taken."""
    changed = git("status", "--porcelain").splitlines()
    faults = [f"not committed: {line.strip()}" for line in changed]
    if git("tag", "--list", tag):
        faults.append(f"the tag {tag} exists: raise the version in pyproject.toml")
    return faults


def build(out: Path) -> list[Path]:
    """Build a wheel with compiled kernels, one without, and the sdist; check what they hold; CalledProcessError."""
    hatchling = [sys.executable, "-m", "hatchling", "build", "--directory", str(out)]
    for target, kernels in (("wheel", "1"), ("wheel", "0"), ("sdist", "0")):
        env = {**os.environ, "SFM_AUDIT_KERNELS": kernels}
        subprocess.run([*hatchling, "--target", target], cwd=ROOT, env=env, check=True)
    built = sorted(path for path in out.iterdir() if path.name.endswith((".whl", ".tar.gz")))
    subprocess.run([sys.executable, str(ROOT / "scripts" / "check_wheel.py"), *map(str, built)], check=True)
    return built


def main() -> int:
    """Check, build, say what remains to be done; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dry-run", action="store_true", help="write nothing")
    dry = parser.parse_args().dry_run
    version = version_of((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    tag = f"v{version}"
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    faults = (
        [] if _VERSION.fullmatch(version) else [f"pyproject.toml: {version} is no version such as 1.2.3 or 1.2.3rc1"]
    )
    faults += tree_faults(tag) + changelog_faults(changelog, version, unreleased_is_fine=dry)
    out = ROOT / "dist"
    if not dry and out.exists():
        faults.append("dist/ exists: it may hold another release; remove it")
    for fault in faults:
        print(f"release: {fault}", file=sys.stderr)
    if faults:
        return 1
    with tempfile.TemporaryDirectory() as folder:
        built = build(Path(folder) if dry else out)
    foreign = [path.name for path in built if "-linux_" in path.name]
    if foreign:
        print(f"release: {foreign[0]} has no manylinux tag, so no index takes it: build with glibc", file=sys.stderr)
        return 1
    print(f"\nsfm-audit {version} of {git('rev-parse', '--short', 'HEAD')}{' (dry run)' if dry else ''}. What remains:")
    print(f"  git tag -a {tag} -m 'sfm-audit {version}' && git push origin {tag}")
    print(f"  publish {', '.join(path.name for path in built)} from dist/ where packages are published")
    return 0


if __name__ == "__main__":
    sys.exit(main())
