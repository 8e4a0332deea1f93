"""Check that a wheel holds every file of the three packages, data files included, and nothing else."""

import argparse
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("loaders", "audit", "reports")


def in_tree() -> set[str]:
    """Files of the packages, as the wheel should name them."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file())
    return {path.relative_to(ROOT).as_posix() for path in files if path.suffix != ".pyc"}


def in_wheel(path: Path) -> set[str]:
    """Files of a wheel without its own metadata."""
    with zipfile.ZipFile(path) as wheel:
        return {name for name in wheel.namelist() if ".dist-info/" not in name}


def main() -> int:
    """Compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wheel", type=Path)
    path = parser.parse_args().wheel
    expected, found = in_tree(), in_wheel(path)
    for name in sorted(expected - found):
        print(f"{path.name}: lacks {name}", file=sys.stderr)
    for name in sorted(found - expected):
        print(f"{path.name}: should not hold {name}", file=sys.stderr)
    if expected != found:
        return 1
    print(f"{path.name}: {len(found)} files, {path.stat().st_size // 1024} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
