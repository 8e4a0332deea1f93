"""Build the compiled kernels beside their sources (docs/kernels.md).

    scripts/build_kernels.py [--if-stale]

Where there is no C compiler nothing is built and everything works with numpy alone: exit code 69 then, and 1 where the
compiler fails. CC chooses the compiler, arguments included; otherwise cc, gcc or clang. CFLAGS and LDFLAGS are not
heeded: what orders sums and fuses products must not be changed by them.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "sfm_audit" / "audit" / "kernels" / "source"
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY = SOURCES.parent / f"compiled{SUFFIX}"
# Fixed summation order: nothing that lets a compiler reorder. The rest does not change what is computed.
# Without -fno-trapping-math a division or comparison in a choice (x > 0 ? 1 / x : y) makes loops scalar.
FLAGS = [
    "-std=gnu99",
    "-O3",
    "-fno-trapping-math",
    "-fno-math-errno",
    "-fvisibility=hidden",
]
# In sources that do little but multiply and add, a product and a sum are one operation with one rounding wherever the
# compiler finds them together. Every processor for which this is built has it, so that all give the same bits: ARM of
# 64 bits always, x86 since 2013, which the library is asked when it is loaded (version.c). The others say of many
# numbers exactly what numpy says, and nothing is fused in them.
FUSED_SOURCES = ("joint*", "misfit")
FUSES = ("x86_64", "amd64", "aarch64", "arm64")
WIDE = {"x86_64": ["-mavx2", "-mfma"], "amd64": ["-mavx2", "-mfma"]}
ON_ANY_PROCESSOR = "version"
WARNINGS = ["-Wall", "-Wextra", "-Werror=implicit-function-declaration", "-Wno-psabi"]
COMPILERS = ("cc", "gcc", "clang")
NO_COMPILER = f"no C compiler ({', '.join(COMPILERS)}, or CC)"
LIMIT_SECONDS = 600
EXIT_UNAVAILABLE = 69
OLDEST_MACOS = "11.0"  # the first for both kinds of processors
OLDEST_GLIBC = (2, 17)  # manylinux tags below are known to nobody who has a Python that we support
ALLOWED_LIBRARIES = {"libc.so.6", "libm.so.6"}  # every system of a manylinux tag has them


def sources_hash() -> str:
    """As sfm_audit.audit.kernels.library computes it, which cannot be imported while the package is built."""
    digest = hashlib.sha256()
    for path in sorted(SOURCES.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def compiler() -> list[str] | None:
    """The C compiler with its arguments: CC, otherwise the first of the usual names that is there."""
    try:
        named = shlex.split(os.environ.get("CC", ""), posix=os.name != "nt")
    except ValueError:  # an open quote
        return None
    for command in [named] if named else [[name] for name in COMPILERS]:
        if shutil.which(command[0]):
            return command
    return None


def platform_flags() -> list[str]:
    """What the operating system needs: macOS to know for which of its versions, the others position independence."""
    if sys.platform == "darwin":
        return ["-fPIC", "-arch", platform.machine(), f"-mmacosx-version-min={OLDEST_MACOS}"]
    return ["-static-libgcc"] if sys.platform == "win32" else ["-fPIC"]


def processor_flags(source: str) -> list[str]:
    """What is asked of the processor by a source, and whether its products and sums are fused."""
    machine = platform.machine().lower()
    is_fused = machine in FUSES and any(fnmatch(source, each) for each in FUSED_SOURCES)
    wide = [] if source == ON_ANY_PROCESSOR else WIDE.get(machine, [])
    return [*wide, f"-ffp-contract={'fast' if is_fused else 'off'}"]


def build(library: Path = LIBRARY, extra: list[str] | None = None) -> str | None:
    """Compile the sources beside each other and link them; None when it worked, else why there is no library."""
    command = compiler()
    if command is None:
        return NO_COMPILER
    partial = library.with_suffix(f".{os.getpid()}.partial")
    extra = ["-s"] if extra is None and sys.platform != "darwin" else extra or []  # -s: no names of static functions
    common = [*command, *FLAGS, *platform_flags(), *WARNINGS, *extra]
    compiled = [*common, f'-DSFM_SOURCES="{sources_hash()}"', "-c"]
    try:
        with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            objects = {str(Path(folder) / f"{source.stem}.o"): str(source) for source in sorted(SOURCES.glob("*.c"))}
            problems = list(
                pool.map(
                    lambda item: _run([*compiled, *processor_flags(Path(item[1]).stem), "-o", *item]), objects.items()
                )
            )
            problems.append(
                _run([*common, "-shared", "-o", str(partial), *objects, "-lm"]) if not any(problems) else ""
            )
        wrong = next(filter(None, problems), None)
        if wrong is not None:
            return f"{shlex.join(command)} failed: {wrong}"
        partial.replace(library)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{shlex.join(command)} cannot be used: {error}"
    finally:
        partial.unlink(missing_ok=True)
    return None


def _run(command: list[str]) -> str:
    """Run the compiler; return what is wrong, nothing where it worked. Warnings are printed."""
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
        stdin=subprocess.DEVNULL,
        timeout=LIMIT_SECONDS,
    )
    if done.returncode:
        return done.stderr.strip() or f"exit code {done.returncode}"
    if done.stderr:
        print(done.stderr, file=sys.stderr)
    return ""


def is_stale(library: Path = LIBRARY) -> bool:
    """Whether the library is missing or carries the hash of other sources."""
    return not library.exists() or sources_hash().encode() not in library.read_bytes()


def platform_tag(library: Path) -> str:
    """Return the tag of a wheel that holds this library: the systems on which it can be loaded.

    With glibc its oldest version that has all symbols that the library asks for (manylinux_2_x), read from the names in
    the library itself; names that stand there for another reason make the tag stricter, never wrong.
    """
    if sys.platform == "darwin":
        return f"macosx_{OLDEST_MACOS.replace('.', '_')}_{platform.machine()}"
    tag = re.sub(r"[-.]", "_", sysconfig.get_platform())
    content = library.read_bytes()
    needed = {name.decode() for name in re.findall(rb"lib[\w.+-]+\.so(?:\.\d+)*", content)}
    versions = {name.decode() for name in re.findall(rb"GLIBC_(\w+(?:\.\w+)*)", content)}
    numbered = {tuple(map(int, version.split("."))) for version in versions if re.fullmatch(r"2(\.\d+)+", version)}
    has_glibc = tag.startswith("linux_") and platform.libc_ver()[0] == "glibc"
    if not has_glibc or needed - ALLOWED_LIBRARIES or len(numbered) < len(versions):
        return tag  # musl, another library, or a feature of glibc that has no number
    major, minor = max([OLDEST_GLIBC, *(version[:2] for version in numbered)])
    return f"many{tag.replace('linux_', f'linux_{major}_{minor}_', 1)}"


def main() -> int:
    """Build, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--if-stale", action="store_true", help="only where the library is of other sources")
    args = parser.parse_args()
    if args.if_stale and not is_stale():
        LIBRARY.touch()  # who looks at times of change alone need not ask again
        return 0
    problem = build()
    if problem is not None:
        print(f"build_kernels: {problem}", file=sys.stderr)
        return EXIT_UNAVAILABLE if problem == NO_COMPILER else 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
