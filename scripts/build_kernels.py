"""Build the compiled kernels beside their sources (docs/kernels.md).

    scripts/build_kernels.py [--if-stale]

Where there is no C compiler nothing is built and everything works with numpy alone.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "sfm_audit" / "audit" / "kernels" / "source"
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY = SOURCES.parent / f"compiled{SUFFIX}"
# Fixed summation order: nothing that lets a compiler reorder or fuse. The rest does not change what is computed.
FLAGS = ["-std=gnu99", "-O3", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"]
WARNINGS = ["-Wall", "-Wextra", "-Werror=implicit-function-declaration"]


def sources_hash() -> str:
    """As sfm_audit.audit.kernels.library computes it, which cannot be imported while the package is built."""
    digest = hashlib.sha256()
    for path in sorted(SOURCES.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def compiler() -> list[str] | None:
    """The C compiler: CC, then the usual names."""
    named = os.environ.get("CC", "").split()
    for command in [named] if named else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    return None


def build(library: Path = LIBRARY, extra: list[str] | None = None) -> str | None:
    """Compile; None when it worked, else why there is no library."""
    command = compiler()
    if command is None:
        return "no C compiler (CC, cc, gcc, clang)"
    partial = library.with_suffix(f".{os.getpid()}.partial")
    sources = [str(path) for path in sorted(SOURCES.glob("*.c"))]
    hashed = [f'-DSFM_SOURCES="{sources_hash()}"']
    done = subprocess.run(
        [*command, *FLAGS, *WARNINGS, *(extra or []), *hashed, "-o", str(partial), *sources, "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        partial.unlink(missing_ok=True)
        return f"{' '.join(command)} failed:\n{done.stderr}"
    if done.stderr:
        print(done.stderr, file=sys.stderr)
    partial.replace(library)
    return None


def is_stale() -> bool:
    """Whether the library is missing or older than a source."""
    if not LIBRARY.exists():
        return True
    built = LIBRARY.stat().st_mtime
    return any(path.stat().st_mtime > built for path in SOURCES.glob("*.[ch]"))


def main() -> int:
    """Build, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--if-stale", action="store_true", help="only where the library is older than its sources")
    args = parser.parse_args()
    if args.if_stale and not is_stale():
        return 0
    problem = build()
    if problem is not None:
        print(f"build_kernels: {problem}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
