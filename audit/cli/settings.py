"""Which settings hold? The defaults, then the config file, then the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from audit.cli.errors import ExitCode, KnownError
from audit.config import AuditConfig


def read_config(file: Path | None, options: Mapping[str, Any]) -> AuditConfig:
    """Return the settings of a run.

    Parameters
    ----------
    file : a TOML file with settings by name, or None
    options : what the command line says; None where it says nothing

    Raises
    ------
    KnownError
        The file cannot be read, has an unknown key, or a value of the wrong kind.
    """
    from_file = {} if file is None else _checked(_read_toml(file), file)
    return AuditConfig.model_validate({**from_file, **{k: v for k, v in options.items() if v is not None}})


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise KnownError(f"{file}: cannot be read ({error.strerror})", ExitCode.USAGE) from error
    except ValueError as error:  # TOMLDecodeError, UnicodeDecodeError
        raise KnownError(f"{file}: not a TOML file: {error}", ExitCode.USAGE) from error


def _checked(content: dict[str, Any], file: Path) -> dict[str, Any]:
    try:
        AuditConfig.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            problem = f"unknown setting {key}; expected one of {', '.join(AuditConfig.model_fields)}"
        else:
            wanted = first["msg"].removeprefix("Input should be ")
            problem = f"{key}: expected {wanted}, found {first['input']!r}"
        raise KnownError(f"{file}: {problem}", ExitCode.USAGE) from error
    return content
