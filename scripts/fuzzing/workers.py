"""Processes that try inputs, with limits of memory and time; one that hangs or dies costs its input and is replaced."""

from __future__ import annotations

import multiprocessing as mp
import os
import resource
import shutil
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from scripts.fuzzing.cases import PLACE, Case, write_case
from scripts.fuzzing.outcomes import Outcome
from scripts.fuzzing.targets import attempt

_CONTEXT: Final = mp.get_context("spawn")
_START_SECONDS: Final = 120.0


class Worker:
    """One process that tries inputs, or reads them with pycolmap.

    memory_bytes: of its address space.    seconds: for one input.
    """

    def __init__(self, *, memory_bytes: int, seconds: float, with_pycolmap: bool = False) -> None:
        self._memory_bytes = memory_bytes
        self._seconds = seconds
        self._entry = _serve_pycolmap if with_pycolmap else _serve
        self._process: Any = None
        self._pipe: Connection | None = None

    def attempt(self, target: str, case: Case) -> Outcome:
        """Return what came of an input; HANG and CRASH where the process did not say."""
        pipe = self._started()
        try:
            pipe.send((target, case))
            if not pipe.poll(self._seconds):
                self.stop()
                return Outcome("HANG", f"more than {self._seconds:g} s")
            outcome: Outcome = pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join(10)
            code = self._process.exitcode
            self.stop()
            return Outcome("CRASH", f"exit code {code}")
        return outcome

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        self._process = self._pipe = None

    def _started(self) -> Connection:
        if self._pipe is None:
            self._pipe, theirs = _CONTEXT.Pipe()
            self._process = _CONTEXT.Process(target=self._entry, args=(theirs, self._memory_bytes), daemon=True)
            self._process.start()
            theirs.close()
            if not self._pipe.poll(_START_SECONDS):
                raise RuntimeError("a worker does not start")
            self._pipe.recv()
        return self._pipe


def _serve(pipe: Connection, memory_bytes: int) -> None:
    """Try inputs until the pipe is closed."""
    import sfm_audit.audit.cli.run  # noqa: F401, PLC0415 - before memory is limited, and not while the clock runs

    _prepare(memory_bytes)
    pipe.send(None)
    while True:
        try:
            target, case = pipe.recv()
        except EOFError:
            return
        before = _peak_bytes()
        outcome = attempt(target, case)
        grown = _peak_bytes() - before
        if outcome.is_good and grown > memory_bytes // 8:
            outcome = Outcome("MEMORY", f"{grown >> 20} MB")
        pipe.send(outcome)


def _serve_pycolmap(pipe: Connection, memory_bytes: int) -> None:
    """Read models with pycolmap until the pipe is closed: ok or refused."""
    import pycolmap  # noqa: PLC0415 - in this process only: it may end it

    _prepare(memory_bytes)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    pipe.send(None)
    while True:
        try:
            _, case = pipe.recv()
        except EOFError:
            return
        root = Path(tempfile.mkdtemp(prefix="fuzz-", dir=PLACE))
        try:
            write_case(case, root)
            reconstruction = pycolmap.Reconstruction()
            getattr(reconstruction, f"read_{case.layout}")(str(root))
            outcome = Outcome("ok")
        except Exception as error:  # noqa: BLE001 - whatever pycolmap raises is its refusal
            outcome = Outcome("refused", " ".join(str(error).split())[:150])
        finally:
            shutil.rmtree(root, ignore_errors=True)
        pipe.send(outcome)


def _prepare(memory_bytes: int) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    used = _address_space()
    resource.setrlimit(resource.RLIMIT_AS, (used + memory_bytes, used + memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _address_space() -> int:
    """Bytes of address space that this process has taken."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
