"""Is there a compiled library that fits these sources, and is it to be used? (docs/kernels.md)."""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path as FilePath
from typing import Any, Final, NamedTuple, cast

import numpy as np

SOURCES: Final = FilePath(__file__).resolve().parent / "source"
_SUFFIX: Final = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY: Final = FilePath(__file__).resolve().parent / f"compiled{_SUFFIX}"
VARIABLE: Final = "SFM_AUDIT_KERNELS"
"""Environment variable: 0 takes the numpy path, 1 insists on the compiled one, anything else takes what is there."""

Doubles: Final = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
Ints: Final = np.ctypeslib.ndpointer(np.int64, flags="C_CONTIGUOUS")
SmallInts: Final = np.ctypeslib.ndpointer(np.int32, flags="C_CONTIGUOUS")
Bytes: Final = np.ctypeslib.ndpointer(np.uint8, flags="C_CONTIGUOUS")
Size: Final = ctypes.c_int64
Double: Final = ctypes.c_double


class Path(NamedTuple):
    """Which path numbers take: "compiled" or "numpy", and why.    sources: hash of the C sources of the first."""

    name: str
    reason: str
    sources: str | None = None

    def __str__(self) -> str:
        return self.name if self.sources is None else f"{self.name} {self.sources[:_SHOWN_HASH]}"


class KernelError(RuntimeError):
    """The compiled path was insisted on and is not there."""


_SHOWN_HASH: Final = 12
_forced_off = False


def sources_hash(folder: FilePath = SOURCES) -> str:
    """Return the hash of all C sources, names included."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@cache
def _loaded() -> tuple[ctypes.CDLL | None, str]:
    """The library, or why there is none."""
    if not LIBRARY.exists():
        return None, "no library was built with this installation (no C compiler then)"
    try:
        found = ctypes.CDLL(str(LIBRARY))
        found.sfm_audit_sources.restype = ctypes.c_char_p
        built_from = found.sfm_audit_sources().decode()
    except (OSError, AttributeError) as error:
        return None, f"{LIBRARY.name} cannot be loaded: {error}"
    if built_from != sources_hash():
        return None, f"{LIBRARY.name} is of other sources: run scripts/build_kernels.py"
    if not found.sfm_audit_runs_here():
        return None, f"{LIBRARY.name} needs a processor with AVX2 and FMA (made since 2013)"
    return found, f"{LIBRARY.name} of sources {built_from[:_SHOWN_HASH]}"


def library() -> ctypes.CDLL | None:
    """Return the compiled library; None where the numpy path is to be taken."""
    wanted = os.environ.get(VARIABLE, "")
    if _forced_off or wanted == "0":
        return None
    found, reason = _loaded()
    if found is None and wanted == "1":
        raise KernelError(f"{VARIABLE}=1, but there are no compiled kernels: {reason}")
    return found


@cache
def _prepared(name: str, arguments: tuple[Any, ...]) -> Callable[..., int]:
    found, _ = _loaded()
    function = getattr(found, name)
    function.argtypes, function.restype = list(arguments), Size
    return cast("Callable[..., int]", function)


def kernel(name: str, *arguments: Any) -> Callable[..., int] | None:
    """Return a C function that takes arguments of these types and returns a status; None for the numpy path.

    Types are those of this module: arrays are checked for type and order at every call, never copied. The interpreter
    is free for other threads while it runs.
    """
    return _prepared(name, arguments) if library() is not None else None


def kernels_in_use() -> bool:
    """Whether numbers come from the compiled kernels."""
    return library() is not None


def path_taken() -> Path:
    """Return which path numbers take in this process, for run.json and for people."""
    if _forced_off or os.environ.get(VARIABLE, "") == "0":
        return Path("numpy", f"{VARIABLE}=0" if not _forced_off else "asked for")
    found, reason = _loaded()
    return Path("numpy", reason) if found is None else Path("compiled", reason, sources_hash())


@contextmanager
def numpy_only() -> Iterator[None]:
    """Take the numpy path inside, whatever is there: tests compare both."""
    global _forced_off  # noqa: PLW0603
    before, _forced_off = _forced_off, True
    try:
        yield
    finally:
        _forced_off = before
