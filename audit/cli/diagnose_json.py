"""What does a program want to know of a diagnosis? The JSON of ``diagnose --json``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfm_audit.reports.run_folder.reader import Row

if TYPE_CHECKING:
    from sfm_audit.audit.diagnose.model import ModelEvidence

_SHAPE: Final = 1  # raised when a key changes its meaning or goes
_KEYS: Final = ("dataset", "scene", "component", "model_path", "diagnoses")


def model_as_json(row: Row, found: ModelEvidence | None, problem: str | None) -> dict[str, Any]:
    """Return what was found out of a model.

    Parameters
    ----------
    row : of ``RUN/models``            found : None where ``problem`` says why there is nothing
    """
    content: dict[str, Any] = {name: row[name] for name in _KEYS} | {"problem": problem}
    if found is None:
        return content | {"numbers": {}, "readings": [], "refits": [], "conclusion": None}
    refits = [
        {"camera_model": each.camera_model, "problem": each.problem, "numbers": _finite(each.numbers), "reading": said}
        for each, said in zip(found.refits, found.refit_readings, strict=True)
    ]
    return content | {
        "numbers": _finite(found.numbers),
        "readings": list(found.readings),
        "refits": refits,
        "conclusion": found.conclusion,
    }


def diagnosis_bytes(run: Path, models: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the whole file, of models from `model_as_json`."""
    return f"{json.dumps({'shape': _SHAPE, 'run': str(run), 'models': models}, indent=1)}\n".encode()


def _finite(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """JSON knows no NaN: a number that nothing says is null."""
    return {name: value if math.isfinite(value) else None for name, value in numbers.items()}
