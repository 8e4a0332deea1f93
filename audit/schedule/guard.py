"""What becomes of a bug? The failure of the one model that met it, with what is needed to find it; the rest goes on."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
import traceback
from typing import Final

from sfm_audit.audit.schedule.lanes import Exceeded, ProcessDiedError
from sfm_audit.audit.schedule.task import AuditFunction, Failure, FailureKind, Outcome, Task
from sfm_audit.loaders import LoadError

_LIBRARIES: Final = ("numpy", "scipy", "pyarrow", "pycolmap", "pydantic")
_SHOWN: Final = 200
_FRAMES: Final = -60  # the last ones: an endless recursion has a thousand


def guarded(audit: AuditFunction, task: Task) -> Outcome:
    """Audit a model; any error becomes its failure. The death of a process it had started is raised."""
    try:
        return audit(task)
    except ProcessDiedError:
        raise
    except LoadError as error:  # a file that vanished in the middle
        return Failure(task.ref.model_path, str(error))
    except Exception as error:  # noqa: BLE001 - the one place for errors nobody expects: one model must not end a night
        return _bug(task, error)


def exceeded(task: Task, how: Exceeded) -> Failure:
    """Return the failure of a model whose audit was ended because it took too much."""
    path = task.ref.model_path
    option = {"memory": "--max-model-memory", "time": "--max-model-seconds"}[how.kind]
    return Failure(path, f"{path}: its audit was ended at {how} ({option}); raise the limit, or leave it out", how.kind)


def _bug(task: Task, error: Exception) -> Failure:
    path = task.ref.model_path
    kind: FailureKind = "memory" if isinstance(error, MemoryError) else "error"
    said = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")[:_SHOWN]
    if kind == "memory":
        message = f"{path}: memory was too short to audit it ({said}); run it again where there is more"
    else:
        message = f"{path}: a bug ended its audit ({said}); all others were audited; please report it"
    return Failure(path, message, kind, _report(task, error))


def _report(task: Task, error: Exception) -> str:
    """Return all that is needed to find the bug, and nothing of the data."""
    versions = [f"sfm-audit {importlib.metadata.version('sfm-audit')}", f"Python {sys.version.split()[0]}"]
    versions += [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    lines = [
        f"model: {task.ref.model_path}",
        f"versions: {', '.join(versions)}, on {platform.platform()}",
        f"settings: {task.config.model_dump_json()}",
        f"observations: {task.observations}, processes: {task.num_processes}, threads: {task.num_threads}",
        "",
        "".join(traceback.format_exception(error, limit=_FRAMES)),
    ]
    return "\n".join(lines)
