"""One run from PATHs to tables and a summary: what the verbs ``run`` and ``demo`` have in common."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.journal import note
from sfm_audit.audit.cli.progress import Progress
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.kernels import KernelError, kernels_in_use, path_taken
from sfm_audit.audit.schedule.errors import ClusterError
from sfm_audit.audit.schedule.memory import give_back
from sfm_audit.audit.schedule.processes import BYTES_WORTH_A_PROCESS
from sfm_audit.audit.schedule.runner import audit_many
from sfm_audit.audit.schedule.task import NO_LIMITS, Failure, Limits
from sfm_audit.loaders import Discovery, ModelRef
from sfm_audit.reports.errors import OutputError, RunFolderError
from sfm_audit.reports.run_folder.record import INPUT_KINDS
from sfm_audit.reports.run_folder.store import RunFailure, RunSettings, RunStore


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What a user asks for.

    jobs: number of processes, None for as many as there are CPUs and work for them.
    observations: whether to write a row per inlier too.
    dask: address of a Dask scheduler, or "local"; None without Dask.
    limits: what the audit of one may take.    verify: whether to read unchanged inputs again.
    """

    paths: Sequence[str]
    folder: Path
    config: AuditConfig
    jobs: int | None = None
    quiet: bool = False
    observations: bool = False
    dask: str | None = None
    limits: Limits = NO_LIMITS
    verify: bool = False


def run_audit(request: RunRequest, found: Discovery) -> ExitCode:
    """Audit what was found below the PATHs into a run folder; one line on stderr per input that cannot be read.

    Raises
    ------
    KnownError
        The run folder cannot be used or written, or the Dask cluster cannot be used.
    """
    if request.dask is not None and importlib.util.find_spec("distributed") is None:
        raise KnownError("--dask needs the extra cluster: pip install 'sfm-audit[cluster]'", ExitCode.USAGE)
    start = time.perf_counter()
    _say_path(request)
    num_bytes = sum(ref.num_bytes for ref in found.refs)
    note(f"run {' '.join(request.paths)} -o {request.folder}: {len(found.refs)} models, {num_bytes / 1e6:.1f} MB")
    problems = [RunFailure(error.path, str(error)) for error in found.errors]
    if found.refs:
        try:
            _write_run(request, found, problems, start)
        except (RunFolderError, ClusterError) as error:
            raise KnownError(str(error), ExitCode.USAGE) from error
        except OutputError as error:
            raise KnownError(str(error), max(ExitCode.OUTPUT, _say(problems, request.folder))) from error
    return _say(problems, request.folder)


def _say_path(request: RunRequest) -> None:
    """Say once, to whoever watches, whether numbers come from compiled kernels or from numpy alone."""
    try:
        compiled = kernels_in_use()
    except KernelError as error:
        raise KnownError(str(error), ExitCode.USAGE) from error
    name, reason, _ = path_taken()
    said = f"computing with compiled kernels ({reason})" if compiled else f"computing with {name} alone: {reason}"
    note(said)
    if not request.quiet and sys.stderr.isatty():
        click.echo(f"sfm-audit: {said}", err=True)


def _say(problems: Sequence[RunFailure], folder: Path) -> ExitCode:
    """Print a line on stderr per problem; return the highest exit code of them."""
    codes = [ExitCode.OK]
    for problem in problems:
        where = f" ({folder / problem.report})" if problem.report else ""
        complain(problem.message + where)
        codes.append(ExitCode.UNREADABLE_INPUT if problem.kind in INPUT_KINDS else ExitCode.AUDIT_STOPPED)
    return max(codes)


def print_summary(folder: Path) -> None:
    """Print the summary of a run folder.

    Raises
    ------
    KnownError
        It holds no run that can be read.
    """
    from sfm_audit.reports.run_folder.reader import RunReader  # noqa: PLC0415 - not with --quiet
    from sfm_audit.reports.text.summary import render_summary  # noqa: PLC0415

    try:
        print_page(render_summary(RunReader.open(folder), terminal_page()))
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error


def _write_run(request: RunRequest, found: Discovery, problems: list[RunFailure], start: float) -> None:
    """Audit into the run folder; what goes wrong with a model is added to ``problems`` at once, in the end in order."""
    before = list(problems)
    settings = RunSettings(
        importlib.metadata.version("sfm-audit"),
        request.config.model_dump(),
        list(request.paths),
        _paths_without_models(request.paths, found),
        request.observations,
        path_taken()._asdict(),
    )
    silent = request.quiet or not sys.stderr.isatty()
    store = RunStore(request.folder, settings)
    store.refuse_to_forget(found.left_out)

    def as_said(failure: Failure) -> RunFailure:
        return RunFailure(failure.location, failure.message, failure.kind, store.reports.get(failure.location))

    with store, Progress(found.refs, silent=silent) as progress:

        def on_done(ref: ModelRef) -> None:
            progress.advance(ref)
            note(f"audited {ref.model_path} after {time.perf_counter() - start:.1f} s")
            give_back()

        def on_skip(ref: ModelRef) -> None:
            progress.skip(ref)
            note(f"unchanged, kept {ref.model_path}")

        failures = audit_many(
            found.refs,
            request.config,
            jobs=request.jobs or _sensible_jobs(found),
            sink=store,
            on_done=on_done,
            on_skip=on_skip,
            on_failure=lambda failure: problems.append(as_said(failure)),
            observations=request.observations,
            dask=request.dask,
            limits=request.limits,
            verify=request.verify,
        )
        problems[:] = [*before, *map(as_said, failures)]
        # a PATH that is not there today, such as a disk that is not mounted, does not cost the tables made from it
        keep = None if found.errors else [ref.key for ref in found.refs]
        store.finish(keep, problems, time.perf_counter() - start, _told())


def _told() -> dict[str, str]:
    """Return when this is, and the command that the user gave; people read it on the page."""
    told = {"finished": datetime.now(UTC).isoformat(timespec="seconds")}
    context = click.get_current_context(silent=True)
    if context is not None and isinstance(context.obj, tuple):
        told["command"] = shlex.join(["sfm-audit", *context.obj])
    return told


def _paths_without_models(paths: Sequence[str], found: Discovery) -> frozenset[str]:
    failed = {error.path for error in found.errors}
    return frozenset(path for path in paths if path in failed)


def _sensible_jobs(found: Discovery) -> int:
    """Return one process per CPU, fewer where starting them costs more than they save."""
    num_cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    num_bytes = sum(ref.num_bytes for ref in found.refs)
    return max(1, min(num_cpus, num_bytes // BYTES_WORTH_A_PROCESS))
