"""Freed memory is kept by processes of ours where glibc allocates, and given back between models; nothing elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sfm_audit.audit.schedule import memory

try:
    IS_GLIBC = bool(os.confstr("CS_GNU_LIBC_VERSION"))
except (AttributeError, ValueError):
    IS_GLIBC = False
NEEDS_GLIBC = pytest.mark.skipif(not IS_GLIBC, reason="another C library than glibc")

CHILD = """
import sys
import numpy as np
from sfm_audit.audit.schedule.memory import give_back, keep_freed

def pages():
    _, resident, shared = map(int, open("/proc/self/statm").read().split()[:3])
    return (resident - shared) * 4096 // 1_000_000

if sys.argv[1] == "keep":
    assert keep_freed()
before = pages()
arrays = [np.ones(1_000_000) for _ in range(30)]
del arrays
kept = pages() - before
print(before, kept, give_back(is_limited=True), pages() - before)
"""


def run(how: str, **environment: str) -> list[str]:
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    command = [sys.executable, "-c", CHILD, how]
    done = subprocess.run(command, env={**clean, **environment}, check=True, capture_output=True, text=True)
    return done.stdout.split()


@NEEDS_GLIBC
def test_what_was_freed_stays_until_it_is_given_back() -> None:
    before, kept, was_much, after = run("keep")
    assert int(kept) > 200, (before, kept)
    assert was_much == "True"
    assert int(after) < 40


@NEEDS_GLIBC
def test_a_process_that_was_not_asked_keeps_nothing() -> None:
    _, kept, was_much, _ = run("as it is")
    assert int(kept) < 40
    assert was_much == "False"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine with 8 GB left, where this process keeps 501 MB of its own, and gives back when asked."""
    (tmp_path / "statm").write_text(f"0 {600_000_000 // 4096 + 1} {99_000_000 // 4096} 0 0 0 0\n")
    (tmp_path / "meminfo").write_text("MemTotal: 16000000 kB\nMemAvailable: 8000000 kB\n")
    monkeypatch.setattr(memory.os, "sysconf", lambda _: 4096)
    monkeypatch.setattr(memory, "_SIZES", tmp_path / "statm")
    monkeypatch.setattr(memory, "_OF_MACHINE", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_OF_GROUP", tmp_path)
    monkeypatch.setattr(memory, "_of_glibc", lambda _: lambda __: 1)
    return tmp_path


@pytest.mark.parametrize(
    ("available_kb", "group", "is_much"),
    [
        (8_000_000, None, False),
        (7_700_000, None, True),  # less than sixteen times as much
        (8_000_000, ("max", 10**9), False),
        (8_000_000, (10**10, 10**9), False),
        (8_000_000, (9 * 10**9, 10**9), True),  # the group may take 8.0 more, of which 501 MB are above a sixteenth
        (10**9, ("2 GB", 0), False),
    ],
)
def test_what_is_much_depends_on_what_is_left(
    machine: Path, available_kb: int, group: tuple[object, int] | None, *, is_much: bool
) -> None:
    (machine / "meminfo").write_text(f"MemFree: 1 kB\nMemAvailable: {available_kb} kB\n")
    for name, value in zip(("max", "current"), group or (), strict=False):
        (machine / f"memory.{name}").write_text(f"{value}\n")
    assert memory.give_back() is is_much
    assert memory.give_back(is_limited=True)


@pytest.mark.parametrize("told", ["", "MemAvailable:\n", "MemAvailable: lots\n", None])
def test_where_nobody_says_what_is_left_it_is_given_back(machine: Path, told: str | None) -> None:
    (machine / "meminfo").unlink()
    if told is not None:
        (machine / "meminfo").write_text(told)
    assert memory.give_back()


def test_little_is_kept_however_little_is_left(machine: Path) -> None:
    (machine / "meminfo").write_text("MemAvailable: 1 kB\n")
    (machine / "statm").write_text(f"0 {190_000_000 // 4096} 0 0 0 0 0\n")
    assert not memory.give_back(is_limited=True)


@NEEDS_GLIBC
def test_whoever_chose_an_allocator_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.arena_max=1")
    assert not memory.keep_freed()
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.pthread.rseq=0")
    monkeypatch.setenv("MALLOC_ARENA_MAX", "1")
    assert not memory.keep_freed()


def unknown(name: str) -> Any:
    raise ValueError(name)


def nothing(name: str) -> Any:
    del name


@pytest.mark.parametrize("confstr", [unknown, nothing], ids=["name unknown", "no answer"])
def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch, confstr: Any) -> None:
    monkeypatch.setattr(memory.os, "confstr", confstr, raising=False)
    monkeypatch.setattr(memory, "_KEPT_BYTES", -1)
    assert not memory.keep_freed()
    assert not memory.give_back()


def test_a_system_without_confstr_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(memory.os, "confstr", raising=False)
    assert not memory.keep_freed()


def test_nothing_is_given_back_where_the_system_does_not_say_how_much_there_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(memory, "_SIZES", tmp_path / "statm")
    assert not memory.give_back()


@NEEDS_GLIBC
def test_a_command_keeps_and_an_import_does_not() -> None:
    """Asked of mallopt itself: who calls it while the library is imported, and while a command runs."""
    code = (
        "import sys, sfm_audit.audit.schedule.memory as m; told = []\n"
        "m._of_glibc = lambda name: lambda *values: told.append(name) or 1\n"
        "import sfm_audit, sfm_audit.audit.cli.main as main\n"
        "print(len(told)); sys.argv[1:] = ['explain-code', 'fine']\n"
        "sys.exit = lambda code: print(len(told))\n"
        "main.entry_point()"
    )
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    done = subprocess.run([sys.executable, "-c", code], env=clean, check=True, capture_output=True, text=True)
    first, *_, last = done.stdout.split()
    assert (first, last) == ("0", "3")
