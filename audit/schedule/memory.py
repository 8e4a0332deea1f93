"""Freed memory: kept by processes of ours for what comes next, and given back between two models where it is much.

glibc gives a freed array back to the system and asks for another one a moment later; the system clears its pages each
time, which was a tenth of an audit. A model that follows asks for as much again: what is kept is much where it is more
than a sixteenth of what the machine has left. Only where glibc allocates, and only in processes that do nothing but our
work: the command line and its workers. Whoever imports the library keeps the allocator as it was.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

_LARGEST: Final = 1 << 25  # above this glibc does not let an array lie among the others: those always go back
_MALLOPT: Final = {  # by the numbers of glibc's malloc.h
    -3: _LARGEST,  # M_MMAP_THRESHOLD
    -1: (1 << 31) - 1,  # M_TRIM_THRESHOLD
    -8: 1,  # M_ARENA_MAX: what one thread freed is there for the others, who seldom ask at the same time
}
_KEPT_BYTES: Final = 200_000_000  # imports take 80 million, a model of 20 images as much again
_KEPT_SHARE: Final = 16  # of what is available
_SIZES: Final = Path("/proc/self/statm")
_OF_MACHINE: Final = Path("/proc/meminfo")
_OF_GROUP: Final = Path("/sys/fs/cgroup")  # of a container, which sees its own


def keep_freed() -> bool:
    """Keep freed memory for what comes next; return whether that could be arranged.

    Nothing is changed where the environment says how malloc is to behave.
    """
    if any(name.startswith("MALLOC_") for name in os.environ) or "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return False
    mallopt = _of_glibc("mallopt")
    return mallopt is not None and all(mallopt(name, value) == 1 for name, value in _MALLOPT.items())


def give_back(*, is_limited: bool = False) -> bool:
    """Give back what was kept, if it is much, between two models: the next may be small; return whether it was much.

    is_limited: somebody watches how much this process takes; above 200 MB is then much however much there is.
    """
    kept = _private_bytes()
    if kept <= _KEPT_BYTES or (not is_limited and kept * _KEPT_SHARE <= _available_bytes()):
        return False
    trim = _of_glibc("malloc_trim")
    return trim is not None and bool(trim(0))


def _private_bytes() -> int:
    """Return how much memory this process has for itself, 0 where the operating system does not say."""
    try:
        _, resident, shared, *_ = map(int, _SIZES.read_text(encoding="ascii").split())
    except OSError:
        return 0
    return (resident - shared) * os.sysconf("SC_PAGE_SIZE")


def _available_bytes() -> int:
    """Return how much memory is left on this machine, or to the group of processes; 0 where nobody says."""
    try:
        lines = _OF_MACHINE.read_text(encoding="ascii").splitlines()
        left = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return 0
    try:
        most, taken = (int((_OF_GROUP / f"memory.{name}").read_text(encoding="ascii")) for name in ("max", "current"))
    except (OSError, ValueError):  # no limit is the word "max"
        return left
    return min(left, most - taken)


def _of_glibc(name: str) -> Any:
    """Return a C function of glibc, None where another C library is used."""
    try:
        version = os.confstr("CS_GNU_LIBC_VERSION") if hasattr(os, "confstr") else None
    except (ValueError, OSError):  # a name that only glibc knows
        return None
    if not version:
        return None
    import ctypes  # noqa: PLC0415 - where there is no glibc, nothing needs it

    return getattr(ctypes.CDLL(None), name, None)
