"""From a gate file to a policy; what is wrong with it is said in one line that names the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.cli.toml_file import read_toml, shown
from sfm_audit.audit.decision.rejections import REJECTING_CODES
from sfm_audit.audit.table.words import ReasonCode
from sfm_audit.reports.compare.gate_policy import Band, GatePolicy, Limits, PartPolicy

_KEYS_OF: Final[dict[str, type[BaseModel]]] = {
    "limits": Limits,
    "band": Band,
    "dataset": PartPolicy,
    "scene": PartPolicy,
}

_OF_REJECTED: Final = "max_share_rejected_by_reason"


def read_gate_file(file: Path, *, has_baseline: bool) -> GatePolicy:
    """Read and validate a gate file.

    Raises
    ------
    KnownError
        It cannot be read, has an unknown key or reason code, a value of the wrong kind, or a limit that needs a
        baseline where there is none.
    """
    content = read_toml(file)
    try:
        policy = GatePolicy.model_validate(content)
    except ValidationError as error:
        raise KnownError(f"{file}: {_problem(error.errors()[0])}", ExitCode.USAGE) from error
    codes = {str(code) for code in ReasonCode}
    for key, code in policy.reason_codes:
        if code not in codes:
            problem = f"unknown reason {code[:80]}{did_you_mean(code, codes) or '; docs/verdicts.md lists them'}"
            raise KnownError(f"{file}: {key}: {problem}", ExitCode.USAGE)
        if key == _OF_REJECTED and code not in REJECTING_CODES:
            problem = f"{code} rejects no image, so no share is too large; use max_share_by_reason"
            raise KnownError(f"{file}: {key}: {problem}", ExitCode.USAGE)
    if policy.needs_baseline and not has_baseline:
        raise KnownError(f"{file}: {policy.needs_baseline} needs --baseline RUN0", ExitCode.USAGE)
    return policy


def _problem(detail: ErrorDetails) -> str:
    name = _dotted(detail["loc"])
    if detail["type"] == "extra_forbidden":
        known: Any = next((_KEYS_OF[part] for part in reversed(detail["loc"][:-1]) if part in _KEYS_OF), GatePolicy)
        keys = known.model_fields
        hint = did_you_mean(str(detail["loc"][-1]), keys) or f"; expected one of {', '.join(keys)}"
        return f"unknown key {name}{hint}"
    if detail["type"] == "missing":
        return f"{name} is missing"
    wanted = detail["msg"].removeprefix("Input should be ")
    return f"{name}: expected {wanted}, found {shown(detail['input'])}"


def _dotted(parts: tuple[int | str, ...]) -> str:
    """Return scene[1].limits.min_images; the first section is [1], as people count."""
    out = ""
    for part in parts:
        out += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    return out.removeprefix(".")[:80]
