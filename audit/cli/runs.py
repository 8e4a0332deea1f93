"""Run folders that are compared: each read whole, or refused in one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from sfm_audit.audit.cli.again import GIVEN, Again, under, valid_settings
from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.terminal import is_stdout, write_stdout
from sfm_audit.reports.compare.comparison import MissingColumnError, RunSnapshot
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.record import INPUT_KINDS


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """A run folder and what its tables say. again: the settings it was decided again under."""

    folder: Path
    info: dict[str, Any]
    snapshot: RunSnapshot
    again: Again = field(default_factory=Again)

    @property
    def decided_again(self) -> str | None:
        """The settings it was decided again under, in words; None for its own."""
        words = self.info.get("decided_again")
        return f"decided again: {words}" if words else None

    @property
    def unread(self) -> list[tuple[str, str]]:
        """Location and message of each input that could not be read."""
        return self._failures(of_inputs=True)

    @property
    def stopped(self) -> list[tuple[str, str]]:
        """Location and message of each model that a bug or a limit stopped: ``run`` ended with exit code 5."""
        return self._failures(of_inputs=False)

    def _failures(self, *, of_inputs: bool) -> list[tuple[str, str]]:
        failures = self.info.get("failures", [])
        return [
            (str(item["location"]), str(item["message"]))
            for item in failures
            if (item["kind"] in INPUT_KINDS) is of_inputs
        ]


def read_run(folder: Path, again: Again | None = None) -> ComparedRun:
    """Read a run folder, under other settings where ``again`` asks for them.

    Raises
    ------
    KnownError
        It holds no run, one that was not finished, tables that cannot be read or cannot be decided so.
    """
    wanted = again or Again()
    return _compared(wanted.read(_finished(folder)), wanted)


def read_run_like(folder: Path, run: ComparedRun) -> ComparedRun:
    """Read a run folder, decided under the settings of another run as far as these decide; errors as of `read_run`.

    Where a setting differs that changes what is measured, it is read as it is (`different_settings` says so).
    """
    from sfm_audit.audit.decision.from_table import FIXED_SETTINGS  # noqa: PLC0415 - SciPy

    found = _finished(folder)
    shared = found.info["config"].keys() & run.info["config"].keys()
    differ = {name for name in shared if found.info["config"][name] != run.info["config"][name]}
    if differ & set(FIXED_SETTINGS):
        return _compared(found, Again())
    if differ:
        found = under(found, valid_settings(run.folder, run.info["config"]), run.again.rejections)
    else:
        found = Again(rejections=run.again.rejections).read(found)
    return _compared(found, run.again)


def _finished(folder: Path) -> RunReader:
    try:
        run = open_run(folder)
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    if run.info.get("status") != "complete":
        problem = f"{folder}: the run was not finished; give its run command again, it goes on where it stopped"
        raise KnownError(problem, ExitCode.UNREADABLE_INPUT)
    return run


def _compared(run: RunReader, again: Again) -> ComparedRun:
    try:
        return ComparedRun(run.folder, run.info, RunSnapshot.read(run), again)
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    except (pa.ArrowException, OSError, MissingColumnError, ValueError) as error:
        problem = f"{run.folder}: its tables cannot be read ({error}); make the run again"
        raise KnownError(problem, ExitCode.UNREADABLE_INPUT) from error


def open_run(folder: Path, *, quiet: bool = False) -> RunReader:
    """Open a run folder, finished or not; a line on stderr says where it could only be checked in part.

    Raises
    ------
    RunFolderError
        It holds no run, or one that was changed.
    """
    run = RunReader.open(folder)
    if run.note is not None and not quiet:
        complain(f"{folder} {run.note}")
    return run


def different_settings(runs: Sequence[ComparedRun]) -> str | None:
    """Say in one line which settings two runs do not share; None where all of them are the same.

    Settings that only one version of sfm-audit knows are not compared.
    """
    first = runs[0]
    for other in runs[1:]:
        old, new = first.info["config"], other.info["config"]
        for name in sorted((old.keys() & new.keys()) - set(GIVEN)):  # another night, another database
            if old[name] != new[name]:
                return f"{other.folder} was made with {name} = {new[name]}, {first.folder} with {old[name]}"
    return None


def refuse_different_settings(runs: Sequence[ComparedRun]) -> None:
    """Refuse to judge verdicts that different settings have reached.

    Raises
    ------
    KnownError
        The runs do not share a setting.
    """
    problem = different_settings(runs)
    if problem:
        raise KnownError(f"{problem}; audit both with the same settings", ExitCode.USAGE)


def without_poses(runs: Sequence[ComparedRun]) -> list[str]:
    """Say which runs do not hold the poses of their images, so that nobody takes silence for agreement."""
    return [
        f"{run.folder}: made by sfm-audit {run.info.get('version')}, holds no poses, and where cameras are is not "
        "compared; make the run again"
        for run in runs
        if run.snapshot.images and not run.snapshot.has_poses
    ]


def write_file(path: Path, content: bytes) -> None:
    """Write a report file, over an older one; ``-`` is stdout, and devices are written to.

    Raises
    ------
    KnownError
        The operating system refuses.
    """
    if is_stdout(path):
        write_stdout(content)
        return
    try:
        path.write_bytes(content)
    except OSError as error:
        problem = f"{path}: cannot be written ({error.strerror}); choose another file"
        raise KnownError(problem, ExitCode.OUTPUT) from error
