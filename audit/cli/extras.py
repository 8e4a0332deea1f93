"""What a verb says whose libraries are not installed: which extra brings them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sfm_audit.audit.cli.errors import ExitCode, KnownError


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Turn a library that is not installed into one line that names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        command = f'pip install "sfm-audit[{name}]" (in a checkout: .venv/bin/pip install -e ".[{name}]")'
        advice = f'it belongs to the extra "{name}": {command}'
        raise KnownError(f"{error.name} is not installed; {advice}", ExitCode.USAGE) from error
