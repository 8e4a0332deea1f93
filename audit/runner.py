"""How are many models audited? One by one or in processes, each model's tables into a sink as they are finished.

The content of a run does not depend on the order in which models finish: each model is audited by itself, from its
own files and the config.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import pyarrow as pa
from threadpoolctl import threadpool_limits

from audit.config import AuditConfig
from audit.engine import audit_model
from audit.table import ModelLabels
from loaders import LoadError, ModelRef, open_model
from loaders.input_state import InputState, input_stamp, read_input_state


@dataclass(frozen=True, slots=True)
class Failure:
    """A model that could not be audited: its location as given, and one line that says why."""

    location: str
    message: str


@dataclass(frozen=True, slots=True)
class Task:
    """One model to audit. known_digest: of the input it was last audited with; None when there is no such audit."""

    ref: ModelRef
    config: AuditConfig
    known_digest: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Audited:
    """The tables of one model (by name), the input they were made from, and how long it took."""

    state: InputState
    tables: Mapping[str, pa.Table]
    seconds: float


@dataclass(frozen=True, slots=True)
class Unchanged:
    """The files were touched, their content is what it was: the finished tables hold."""


Outcome = Audited | Unchanged | Failure
AuditFunction = Callable[[Task], Outcome]


class Sink(Protocol):
    """Where the tables of finished models go (reports.store.RunStore)."""

    def finished(self, ref: ModelRef) -> InputState | None:
        """Return the input a model was finished with under this config, or None."""

    def write(self, ref: ModelRef, state: InputState, tables: Mapping[str, pa.Table], seconds: float) -> None:
        """Take the tables of one model, in place of what was there."""

    def drop(self, key: str) -> None:
        """Forget a model."""


def audit_one(task: Task) -> Outcome:
    """Load and audit one model; a model that cannot be read is a Failure, any other error is raised."""
    start = time.perf_counter()
    ref = task.ref
    try:
        state = read_input_state(ref.location)
        if state.digest == task.known_digest:
            return Unchanged()
        model = open_model(ref.location)
    except LoadError as error:
        return Failure(ref.model_path, str(error))
    labels = ModelLabels(ref.dataset, ref.scene, ref.component, ref.model_path)
    try:
        audited = audit_model(model, task.config, labels)
    except BaseException as error:
        error.add_note(f"while auditing {ref.model_path}")
        raise
    tables = {"images": audited.images, "models": audited.models}
    return Audited(state, tables, time.perf_counter() - start)


def audit_many(
    refs: Sequence[ModelRef],
    config: AuditConfig,
    *,
    jobs: int,
    sink: Sink,
    on_done: Callable[[ModelRef], None] = lambda _: None,
    audit: AuditFunction = audit_one,
) -> list[Failure]:
    """Audit models and hand their tables to a sink.

    Parameters
    ----------
    refs : the models, no key twice
    config : the same for all
    jobs : number of processes; 1 audits in this one
    sink : models that it has finished from the same input are not audited again
    on_done : called once per model, in the order in which they finish
    audit : what to do with one model; must be importable by name when jobs > 1

    Returns
    -------
    list of Failure
        Models that could not be read, or whose process died twice, in the order of ``refs``. Their earlier tables are
        removed from the sink.
    """
    failures: dict[str, Failure] = {}
    tasks = []
    for ref in refs:
        known = sink.finished(ref)
        if known is not None and _is_untouched(ref, known):
            on_done(ref)
        else:
            tasks.append(Task(ref, config, known.digest if known else None))
    run = _in_this_process(tasks, audit) if min(jobs, len(tasks)) <= 1 else _in_processes(tasks, jobs, audit)
    for task, outcome in run:
        if isinstance(outcome, Failure):
            failures[task.ref.key] = outcome
            sink.drop(task.ref.key)
        elif isinstance(outcome, Audited):
            sink.write(task.ref, outcome.state, outcome.tables, outcome.seconds)
        on_done(task.ref)
    return [failures[ref.key] for ref in refs if ref.key in failures]


def _is_untouched(ref: ModelRef, known: InputState) -> bool:
    try:
        return input_stamp(ref.location) == known.stamp
    except LoadError:
        return False  # the audit itself will say what is wrong


def _in_this_process(tasks: Sequence[Task], audit: AuditFunction) -> Iterator[tuple[Task, Outcome]]:
    with threadpool_limits(limits=1):
        for task in tasks:
            yield task, audit(task)


def _in_processes(tasks: Sequence[Task], jobs: int, audit: AuditFunction) -> Iterator[tuple[Task, Outcome]]:
    """Yield outcomes as they come; models that were under way when a process died are tried once more, each alone."""
    waiting = deque(tasks)
    while waiting:
        suspects: list[Task] = []
        with _pool(min(jobs, len(waiting))) as pool:
            running: dict[Future[Outcome], Task] = {}
            while running or (waiting and not suspects):
                while waiting and not suspects and len(running) < 2 * jobs:
                    task = waiting.popleft()
                    running[_submit(pool, audit, task)] = task
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    task = running.pop(future)
                    try:
                        outcome = future.result()
                    except BrokenProcessPool:
                        suspects.append(task)
                        continue
                    yield task, outcome
        for task in suspects:
            yield task, _alone(task, audit)


def _submit(pool: ProcessPoolExecutor, audit: AuditFunction, task: Task) -> Future[Outcome]:
    try:
        return pool.submit(audit, task)
    except BrokenProcessPool as error:
        broken: Future[Outcome] = Future()
        broken.set_exception(error)
        return broken


def _alone(task: Task, audit: AuditFunction) -> Outcome:
    with _pool(1) as pool:
        try:
            return _submit(pool, audit, task).result()
        except BrokenProcessPool:
            what = "the process that audited it died twice, the second time with no other beside it"
            advice = "memory may be short (see dmesg); run it again where there is more"
            return Failure(task.ref.model_path, f"{task.ref.model_path}: {what}; {advice}")


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Start a process pool whose workers end at once when the caller is interrupted."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), initializer=_start_worker)
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interrupt means
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threadpool_limits(limits=1)


def _end_with_parent() -> None:
    """Leave when the parent is killed: a worker holds both ends of its queue and would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)
