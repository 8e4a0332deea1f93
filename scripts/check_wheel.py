"""Check that a wheel or an sdist holds every file of the package, data files included, and no other import name.

A wheel for one platform holds the compiled kernels of the sources beside them, and its name says on which systems they
can be loaded; a wheel for any platform (py3-none-any) and an sdist hold none.
"""

import argparse
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from scripts import build_kernels  # noqa: E402 - the folder that holds it is on the path only now

PACKAGE = "sfm_audit"
ROOMS = ("loaders", "audit", "reports")
# Files of an sdist outside the package: what is needed to build it, and what a packager runs and reads.
BESIDE = {".gitignore", "CHANGELOG.md", "CITATION.cff", "LICENSE", "PKG-INFO", "README.md", "pyproject.toml"}
BESIDE_FOLDERS = {"docs", "scripts", "tests"}
LIBRARY = f"{PACKAGE}/audit/kernels/{build_kernels.LIBRARY.name}"


def in_tree() -> set[str]:
    """Files of the package, as a wheel should name them; from the folders, so that the links need not work."""
    return {f"{PACKAGE}/{path.relative_to(ROOT).as_posix()}" for room in ROOMS for path in _files(ROOT / room)} | {
        path.relative_to(ROOT).as_posix() for path in (ROOT / PACKAGE).iterdir() if path.is_file()
    }


def _files(folder: Path) -> Iterator[Path]:
    built = build_kernels.LIBRARY.stem
    return (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc" and path.stem != built)


def in_archive(path: Path) -> set[str]:
    """Files of a wheel, or of an sdist below its folder; without a wheel's own metadata."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            return {name for name in wheel.namelist() if ".dist-info/" not in name}
    with tarfile.open(path) as sdist:
        return {name.partition("/")[2] for name in sdist.getnames()}


def faults(path: Path) -> list[str]:
    """Say what an archive lacks and what it should not hold."""
    expected, found = in_tree(), in_archive(path)
    if path.suffix == ".whl" and not path.stem.endswith("-none-any"):
        expected |= {LIBRARY}
    if path.suffix != ".whl":
        found = {name for name in found if name not in BESIDE and name.partition("/")[0] not in BESIDE_FOLDERS}
    lacks = [f"lacks {name}" for name in sorted(expected - found)]
    wrong = [*lacks, *(f"should not hold {name}" for name in sorted(found - expected))]
    return wrong + (library_faults(path) if LIBRARY in found & expected else [])


def library_faults(wheel: Path) -> list[str]:
    """Say what is wrong with the compiled kernels of a wheel: other sources, or a name for other systems."""
    with zipfile.ZipFile(wheel) as archive, tempfile.TemporaryDirectory() as folder:
        library = Path(archive.extract(LIBRARY, folder))
        tag = f"py3-none-{build_kernels.platform_tag(library)}"
        stale = build_kernels.is_stale(library)
    wrong = [f"{LIBRARY} is of other sources"] if stale else []
    return wrong + ([] if wheel.stem.endswith(f"-{tag}") else [f"its library is one for {tag}"])


def main() -> int:
    """Check each; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", type=Path, nargs="+", metavar="WHEEL|SDIST")
    code = 0
    for path in parser.parse_args().archives:
        wrong = faults(path)
        for fault in wrong:
            print(f"{path.name}: {fault}", file=sys.stderr)
        if wrong:
            code = 1
        else:
            print(f"{path.name}: {len(in_archive(path))} files, {path.stat().st_size // 1024} KiB")
    return code


if __name__ == "__main__":
    sys.exit(main())
