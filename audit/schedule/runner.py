"""How are many models audited? Each by itself, wherever that happens, and its tables into a sink as it is finished.

The content of a run does not depend on the order in which models finish: each model is audited by itself, from its
own files and the config.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Protocol

import pyarrow as pa
from threadpoolctl import threadpool_limits

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.schedule.guard import guarded
from sfm_audit.audit.schedule.processes import in_processes, planned
from sfm_audit.audit.schedule.task import (
    NO_LIMITS,
    Audited,
    AuditFunction,
    Failure,
    Limits,
    Outcome,
    Task,
    Unchanged,
    audit_one,
    evidence_of,
    too_large,
)
from sfm_audit.loaders import LoadError, ModelRef
from sfm_audit.loaders.datasets.input_state import InputState, input_stamp

__all__ = [
    "AuditFunction",
    "Audited",
    "Failure",
    "Limits",
    "Outcome",
    "Sink",
    "Task",
    "Unchanged",
    "audit_many",
    "audit_one",
]


class Sink(Protocol):
    """Where the tables of finished models go (reports.store.RunStore)."""

    def finished(self, ref: ModelRef) -> InputState | None:
        """Return the input a model was finished with under this config, or None."""

    def write(
        self,
        ref: ModelRef,
        state: InputState,
        tables: Mapping[str, pa.Table],
        seconds: float,
        computed_by: str = "",
    ) -> None:
        """Take the tables of one model, in place of what was there; see `Audited`."""

    def drop(self, key: str) -> None:
        """Forget a model."""

    def keep_report(self, ref: ModelRef, text: str) -> None:
        """Keep what a bug in the audit of a model, which has no tables then, left behind."""


def audit_many(
    refs: Sequence[ModelRef],
    config: AuditConfig,
    *,
    jobs: int,
    sink: Sink,
    on_done: Callable[[ModelRef], None] = lambda _: None,
    on_skip: Callable[[ModelRef], None] | None = None,
    on_failure: Callable[[Failure], None] = lambda _: None,
    audit: AuditFunction = audit_one,
    observations: bool = False,
    dask: str | None = None,
    limits: Limits = NO_LIMITS,
    verify: bool = False,
) -> list[Failure]:
    """Audit models and hand their tables to a sink.

    Parameters
    ----------
    refs : the models, no key twice
    config : the same for all
    jobs : number of processes; 1 audits in this one
    sink : models that it has finished from the same input are not audited again
    on_done : called once per model, in the order in which they finish
    on_skip : called in place of ``on_done``, before any model is audited, for models that need no audit
    on_failure : called with every failure when it is known
    audit : what to do with one model; must be importable by name unless it runs in this process
    observations : whether to make the tables of observations too, one row per inlier
    dask : address of a Dask scheduler whose workers audit, or "local": ``jobs`` Dask workers on this machine
    limits : what the audit of one model may take; beyond it, the model is a Failure
    verify : whether to read all files, where otherwise equal sizes and times of change are believed

    Returns
    -------
    list of Failure
        In the order of ``refs``: unreadable, or a bug, a limit or the death of a process ended the audit. The sink
        drops their earlier tables.

    Raises
    ------
    ClusterError
        The Dask cluster cannot be used, or was lost.
    """
    tasks = [
        Task(ref, config, digest, observations, limits=limits)
        for ref, digest in _unfinished(refs, config, sink, on_skip or on_done, verify=verify)
    ]
    with closing(_outcomes(tasks, jobs, audit, dask)) as outcomes:  # an error in the sink ends the processes at once
        failures = _hand_over(outcomes, sink, on_done, on_failure)
    return [failures[ref.key] for ref in refs if ref.key in failures]


def _unfinished(
    refs: Sequence[ModelRef], config: AuditConfig, sink: Sink, on_skip: Callable[[ModelRef], None], *, verify: bool
) -> Iterator[tuple[ModelRef, str | None]]:
    """Models that need an audit, each with the digest of the input that it was finished with, None if it never was."""
    for ref in refs:
        known = sink.finished(ref)
        if known is not None and known.evidence != evidence_of(ref, config):
            known = None  # another database, reference or priors: the same files of the model say something else
        if known is not None and not verify and _is_untouched(ref, known):
            on_skip(ref)
        else:
            yield ref, known.digest if known else None


def _hand_over(
    outcomes: Iterable[tuple[Task, Outcome]],
    sink: Sink,
    on_done: Callable[[ModelRef], None],
    on_failure: Callable[[Failure], None],
) -> dict[str, Failure]:
    """Hand each model's tables to the sink as it is finished; return the failures, whose earlier tables it drops."""
    failures = {}
    for task, outcome in outcomes:
        if isinstance(outcome, Failure):
            failures[task.ref.key] = outcome
            sink.drop(task.ref.key)
            if outcome.report is not None:
                sink.keep_report(task.ref, outcome.report)
            on_failure(outcome)
        elif isinstance(outcome, Audited):
            sink.write(task.ref, outcome.state, outcome.tables, outcome.seconds, outcome.computed_by)
        on_done(task.ref)
    return failures


def _outcomes(
    tasks: Sequence[Task], jobs: int, audit: AuditFunction, dask: str | None
) -> Generator[tuple[Task, Outcome]]:
    """Audit in this process, in processes or on a cluster; elsewhere the largest models go first."""
    yield from ((task, too_large(task)) for task in tasks if task.is_too_large)
    tasks = [task for task in tasks if not task.is_too_large]
    if not tasks:
        return
    is_limited = tasks[0].limits.need_a_process
    if dask is None and jobs <= 1 and not is_limited:
        yield from _in_this_process(tasks, audit)
        return
    plan = planned(tasks, jobs)
    if dask is not None:
        from sfm_audit.audit.schedule.cluster import in_cluster  # noqa: PLC0415 - imports Dask, which only this needs

        yield from in_cluster([replace(task, num_processes=1, num_threads=1) for task in plan], dask, jobs, audit)
    elif len(plan) == 1 and plan[0].num_processes == 1 and not is_limited:
        yield from _in_this_process(plan, audit)
    else:
        yield from in_processes(plan, jobs, audit)


def _is_untouched(ref: ModelRef, known: InputState) -> bool:
    try:
        return (ref.stamp or input_stamp(ref.location)) == known.stamp
    except LoadError:
        return False  # the audit itself will say what is wrong


def _in_this_process(tasks: Sequence[Task], audit: AuditFunction) -> Generator[tuple[Task, Outcome]]:
    with threadpool_limits(limits=1):
        for task in tasks:
            yield task, guarded(audit, task)
