"""Which settings hold? The defaults, then the config file, then the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.cli.toml_file import read_toml, shown
from sfm_audit.audit.config import AuditConfig

_SHOWN: Final = 80  # characters of a name
_CROSS_FIELD: Final = "value_error"  # a rule about several settings, each of which is valid by itself
_PATTERNS: Final = {"min_effect": "a number with its unit, such as 0.2px or 0.5sigma"}


def read_config(file: Path | None, options: Mapping[str, Any]) -> AuditConfig:
    """Return the settings of a run.

    Parameters
    ----------
    file : a TOML file with settings by name, or None
    options : what the command line says; None where it says nothing

    Raises
    ------
    KnownError
        The file cannot be read, has an unknown key, or a value of the wrong kind; an option has a value of the wrong
        kind; or settings contradict each other. The message names the file or the option.
    """
    said = {name: value for name, value in options.items() if value is not None}
    from_file = {} if file is None else read_toml(file)
    if file is not None:
        _refuse_wrong_values(from_file, lambda name: f"{file}: {name}")
    _refuse_wrong_values(said, _option)
    try:
        return AuditConfig.model_validate({**from_file, **said})
    except ValidationError as error:
        sources = [*([str(file)] if from_file else []), *(_option(name) for name in said)]
        problem = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise KnownError(f"{', '.join(sources)}: {problem}", ExitCode.USAGE) from error


def _refuse_wrong_values(content: Mapping[str, Any], place: Callable[[str], str]) -> None:
    """Refuse unknown settings and values of the wrong kind; ``place`` says where a setting was made.

    Settings that contradict each other are no matter of one place: the file may be completed by the command line.
    """
    try:
        AuditConfig.model_validate(content)
    except ValidationError as error:
        wrong = [detail for detail in error.errors() if detail["type"] != _CROSS_FIELD]
        if wrong:
            raise KnownError(_problem(wrong[0], place), ExitCode.USAGE) from error


def _problem(detail: ErrorDetails, place: Callable[[str], str]) -> str:
    name = ".".join(str(part) for part in detail["loc"])[:_SHOWN]
    if detail["type"] == "extra_forbidden":
        where = place(name).removesuffix(name)
        known = AuditConfig.model_fields
        hint = did_you_mean(name, known) or f"; expected one of {', '.join(known)}"
        return f"{where}unknown setting {name}{hint}"
    wanted = detail["msg"].removeprefix("Input should be ")
    if name in _PATTERNS:
        wanted = _PATTERNS[name]
    return f"{place(name)}: expected {wanted}, found {shown(detail['input'])}"


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
