"""How are calls run in other processes? So that the death of one costs nothing but its own call.

concurrent.futures' pool breaks as a whole when one process dies, and waits for ever for the rest of an answer that a
killed process had half written, because it holds both ends of the pipe. Here every process has a pipe of its own, and
only the process holds the end that it writes to.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Generic, Literal, Self, TypeVar

from threadpoolctl import threadpool_limits

from sfm_audit.audit.schedule.garbage import leaving
from sfm_audit.audit.schedule.imports import importing_audits
from sfm_audit.audit.schedule.memory import give_back, keep_freed

_SPAWN: Final = multiprocessing.get_context("spawn")
_BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_LEAVING_SECONDS: Final = 5.0  # that an idle process may take to leave before it is made to

_LOOK_SECONDS: Final = 0.02  # between two looks at a call with limits: 100 MB at the speed at which memory is taken
_PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096

K = TypeVar("K")


@dataclass(frozen=True, slots=True)
class Died:
    """The answer of a process that is gone. exit_code: its own, or minus the number of the signal that killed it."""

    exit_code: int | None

    def __str__(self) -> str:
        if self.exit_code is not None and self.exit_code < 0:
            return f"killed by {signal.Signals(-self.exit_code).name}"
        return f"exit code {self.exit_code}"


@dataclass(frozen=True, slots=True)
class Exceeded:
    """The answer of a process that was ended because its call took more memory or time than it may; amount: of that."""

    kind: Literal["memory", "time"]
    amount: float

    def __str__(self) -> str:
        return f"{self.amount / 1e9:.3g} GB of memory" if self.kind == "memory" else f"{self.amount:.3g} seconds"


class ProcessDiedError(RuntimeError):
    """A process that a call in another process had started is gone."""


class RemoteTracebackError(Exception):
    """Where an error was raised, in the process that met it."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


@dataclass(frozen=True, slots=True)
class _Raised:
    error: BaseException
    trace: str


@dataclass(frozen=True, slots=True)
class _Begun:
    """Sent before a call begins."""


@dataclass(slots=True, eq=False)
class _Lane:
    process: multiprocessing.process.BaseProcess
    connection: Connection
    max_bytes: int | None = None
    max_seconds: float | None = None
    begun: float | None = None  # when the call did: the start of the process and its imports are not its own

    def excess(self) -> Exceeded | None:
        """Say what the call under way has taken too much of; None while it has not."""
        if self.max_seconds is not None and self.begun is not None:
            seconds = time.monotonic() - self.begun
            if seconds > self.max_seconds:
                return Exceeded("time", seconds)
        if self.max_bytes is not None and self.process.pid is not None:
            num_bytes = resident_bytes(self.process.pid)
            if num_bytes > self.max_bytes:
                return Exceeded("memory", num_bytes)
        return None


class Lanes(Generic[K]):
    """Processes that run one call at a time each; they are started when they are needed and kept until the end.

    Use as a context manager: a normal exit waits for the processes to leave, an error ends them at once. Processes that
    are killed are replaced. They also leave when this process is killed.
    """

    def __init__(self) -> None:
        self._idle: list[_Lane] = []
        self._busy: dict[Connection, tuple[_Lane, K]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        lanes = [*self._idle, *(lane for lane, _ in self._busy.values())]
        for lane in lanes:
            lane.connection.close()  # an idle process reads the end of its input and leaves
            if error is not None:
                lane.process.terminate()
        for lane in lanes:
            lane.process.join(_LEAVING_SECONDS)
            if lane.process.is_alive():
                lane.process.kill()
                lane.process.join()
        self._idle, self._busy = [], {}

    def _end_those_over_their_limits(self) -> list[tuple[K, Any]]:
        found = [(connection, *held, held[0].excess()) for connection, held in self._busy.items()]
        ended = []
        for connection, lane, key, excess in found:
            if excess is not None:
                del self._busy[connection]
                lane.process.kill()
                _bury(lane)
                ended.append((key, excess))
        return ended

    @property
    def num_busy(self) -> int:
        """How many calls are under way."""
        return len(self._busy)

    def warm_up(self, num_processes: int) -> None:
        """Start processes now, so that they are ready when they are needed."""
        self._idle += [_open_lane() for _ in range(num_processes - len(self._idle))]

    def start(self, key: K, function: Callable[..., Any], *arguments: Any) -> None:
        """Run a call in an idle process, or in a new one; the function must be importable by name."""
        self.start_limited(key, (None, None), function, *arguments)

    def start_limited(
        self, key: K, limits: tuple[int | None, float | None], function: Callable[..., Any], *arguments: Any
    ) -> None:
        """Run a call that may take so many bytes of memory and so many seconds; where it takes more, it is ended."""
        while True:
            lane = self._idle.pop() if self._idle else _open_lane()
            try:
                lane.connection.send((function, arguments, limits[0] is not None))
            except (BrokenPipeError, ConnectionError):  # killed while it was idle
                _bury(lane)
                continue
            lane.max_bytes, lane.max_seconds = limits
            lane.begun = None
            self._busy[lane.connection] = (lane, key)
            return

    def wait(self) -> list[tuple[K, Any]]:
        """Wait until a call ends; return key and answer of all that have ended, Died for those whose process died.

        An error that a call raises is raised here. A call that exceeds its limits is ended, the answer is Exceeded.
        """
        answers: list[tuple[K, Any]] = []
        while not answers:
            is_limited = any(lane.max_bytes or lane.max_seconds for lane, _ in self._busy.values())
            ready = wait(list(self._busy), _LOOK_SECONDS if is_limited else None)
            answers = self._answers_of(ready) or self._end_those_over_their_limits()
        return answers

    def _answers_of(self, ready: Iterable[Any]) -> list[tuple[K, Any]]:
        answers = []
        for connection in ready:
            lane, key = self._busy[connection]
            try:
                answer = lane.connection.recv()
            except (EOFError, OSError):
                answer = _bury(lane)
            if isinstance(answer, _Begun):
                lane.begun = time.monotonic()
                continue
            del self._busy[connection]
            if not lane.connection.closed:
                self._idle.append(lane)
            if isinstance(answer, _Raised):
                raise answer.error from RemoteTracebackError(answer.trace)
            answers.append((key, answer))
        return answers


def resident_bytes(pid: int) -> int:
    """Return how much memory a process has, 0 where it is gone or the operating system does not say."""
    try:
        text = Path(f"/proc/{pid}/statm").read_text(encoding="ascii")
    except OSError:
        return 0
    return int(text.split()[1]) * _PAGE_BYTES


def _open_lane() -> _Lane:
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_serve, args=(theirs,))
    process.start()
    theirs.close()  # or the end of a killed process would not be noticed
    return _Lane(process, ours)


def _bury(lane: _Lane) -> Died:
    lane.connection.close()
    lane.process.join(_LEAVING_SECONDS)
    if lane.process.is_alive():
        lane.process.kill()
        lane.process.join()
    return Died(lane.process.exitcode)


def _serve(connection: Connection) -> None:
    """Answer calls until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interrupt means
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.update(dict.fromkeys(_BLAS_VARIABLES, "1"))  # for libraries that the first call loads
    keep_freed()
    while True:
        try:
            with importing_audits():  # the first call's function is imported when it arrives
                function, arguments, is_limited = connection.recv()
        except (EOFError, OSError):
            leaving()
            return
        threadpool_limits(limits=1)  # for those that are loaded
        try:
            connection.send(_Begun())
            answer = function(*arguments)
        except BaseException as error:  # noqa: BLE001 - raised again in the parent
            answer = _Raised(error, "".join(traceback.format_exception(error)))
        try:
            connection.send(answer)
        except (BrokenPipeError, ConnectionError):
            return
        del function, arguments, answer
        give_back(is_limited=is_limited)


def _end_with_parent() -> None:
    """Leave when the parent is killed, also in the middle of a call."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
