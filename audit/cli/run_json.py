"""What does a program want to know of a run that ended? The JSON of ``run --json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.run_folder.disk import RUN_JSON
from sfm_audit.reports.run_folder.reader import RunReader

_SHAPE: Final = 1  # raised when a key changes its meaning or goes
_NAMES: Final = ("tool", "version", "status", "config", "counts", "failures", "seconds")


def run_as_json(folder: Path, exit_code: ExitCode) -> bytes:
    """Return counts and failures of a run folder (null where there is none), and the exit code.

    Raises
    ------
    KnownError
        The folder holds no run that can be read.
    """
    info: dict[str, Any] = {}
    if (folder / RUN_JSON).exists():
        try:
            info = RunReader.open(folder).info
        except RunFolderError as error:
            raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    content = {"shape": _SHAPE, "run": str(folder), "exit_code": int(exit_code)}
    content |= {name: info.get(name) for name in _NAMES}
    return f"{json.dumps(content, indent=1)}\n".encode()
