"""Run tests on mutants: a forked process each, in which an import hook hands out the changed source."""

from __future__ import annotations

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final

from scripts.mutation.mutants import Mutant

# What the tests import that is not the project's own: once, before the processes part.
PRELOADED: Final = (
    "numpy",
    "numpy.testing",
    "pyarrow",
    "pydantic",
    "pytest",
    "hypothesis",
    "scipy.special",
    "scipy.linalg",
)
PRELOADED_TOO: Final = ("scipy.sparse", "scipy.optimize", "scipy.stats", "pycolmap", "threadpoolctl")
OWN: Final = ("sfm_audit.audit.misfit", "sfm_audit.loaders.model")
"""What most targets import and are not: loaded once too, and again by the mutants of what is in there."""
TIMEOUT_S: Final = 120.0
_TESTS_PASSED, _TESTS_FAILED, _INTERRUPTED = 0, 1, 2  # pytest's exit codes; collecting a broken module interrupts


class Outcome(Enum):
    """What became of a mutant."""

    DIED = "died"
    SURVIVED = "survived"


class _Changed(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Finds one module, with another source."""

    def __init__(self, mutant: Mutant, root: Path) -> None:
        self._mutant, self._path = mutant, str(root / mutant.file)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Find the mutant's module only."""
        del path, target
        if fullname != self._mutant.module:
            return None
        return importlib.util.spec_from_loader(fullname, self, origin=self._path)

    def pytest_configure(self) -> None:
        """Come before pytest's own hook, which rewrites modules that are called like tests (group_test.py)."""
        sys.meta_path.insert(0, self)

    def get_source(self, fullname: str) -> str:
        """Return the changed source."""
        del fullname
        return self._mutant.source

    def get_code(self, fullname: str) -> CodeType:
        """Compile it."""
        return compile(self.get_source(fullname), self._path, "exec")


class Runner:
    """Processes that run tests, ``jobs`` at a time."""

    def __init__(self, root: Path, jobs: int = 0) -> None:
        self._root = root
        self._jobs = jobs or os.cpu_count() or 1
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # before NumPy comes
        for name in (*PRELOADED, *PRELOADED_TOO, *OWN):
            importlib.import_module(name)

    def check_unchanged(self, tests: Iterable[tuple[str, ...]]) -> None:
        """Raise unless all tests pass on the code as it is."""
        for chosen in sorted(set(tests)):
            with tempfile.TemporaryFile() as log:
                if self._wait(self._start(None, chosen, log.fileno())) != _TESTS_PASSED:
                    log.seek(0)
                    sys.stdout.write(log.read().decode(errors="replace"))
                    raise SystemExit(f"the tests fail without a mutant: {', '.join(chosen)}")

    def run(self, mutants: Sequence[Mutant]) -> Iterator[tuple[Mutant, Outcome]]:
        """Yield each mutant and what became of it, as they end."""
        waiting, running = list(reversed(mutants)), dict[int, tuple[Mutant, float]]()
        with Path(os.devnull).open("w") as nowhere:
            while waiting or running:
                while waiting and len(running) < self._jobs:
                    mutant = waiting.pop()
                    running[self._start(mutant, mutant.tests, nowhere.fileno())] = mutant, time.monotonic()
                for pid, (mutant, started) in list(running.items()):
                    code = self._ended(pid, started)
                    if code is not None:
                        del running[pid]
                        yield mutant, Outcome.SURVIVED if code == _TESTS_PASSED else Outcome.DIED
                time.sleep(0.01)

    def _start(self, mutant: Mutant | None, tests: Sequence[str], log: int) -> int:
        """Return the id of a process that runs the tests."""
        pid = os.fork()
        if pid:
            return pid
        code = 70
        try:
            os.dup2(log, 1)
            os.dup2(log, 2)
            code = self._tested(mutant, tests)
        finally:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
            os._exit(code)

    def _tested(self, mutant: Mutant | None, tests: Sequence[str]) -> int:
        import pytest  # noqa: PLC0415 # imported by the parent already

        hooks = [] if mutant is None else [_Changed(mutant, self._root)]
        sys.meta_path[:0] = hooks
        if mutant is not None and mutant.module in sys.modules:
            for name in [name for name in sys.modules if name.partition(".")[0] == "sfm_audit"]:
                del sys.modules[name]
        os.chdir(self._root)
        arguments = [*(f"tests/{test}" for test in tests), "-x", "-q", "-p", "no:cacheprovider", "--no-header"]
        preloaded = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins that are loaded already
        return int(pytest.main([*arguments, *preloaded], plugins=hooks))

    def _ended(self, pid: int, started: float) -> int | None:
        """Return the exit code of a process, None while it runs; what runs too long is ended and failed."""
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            if code not in {_TESTS_PASSED, _TESTS_FAILED, _INTERRUPTED} and code >= 0:
                raise SystemExit(f"pytest ended with {code}: no tests, or a wrong argument")
            return code
        if time.monotonic() - started > TIMEOUT_S:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return _TESTS_FAILED
        return None

    def _wait(self, pid: int) -> int:
        started = time.monotonic()
        while (code := self._ended(pid, started)) is None:
            time.sleep(0.01)
        return code
