"""Where does a verb's output go? Pages for people to stdout, or to stderr where stdout is asked for by ``-``."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

if TYPE_CHECKING:
    from sfm_audit.reports.text.drawing import Page

_MIN_WIDTH: Final = 40  # narrower tables have no room for numbers
_WIDTH: Final = 80


def is_stdout(path: Path | None) -> bool:
    """Whether an output is ``-``."""
    return path is not None and str(path) == "-"


def one_stdout(outputs: Iterable[Path | None]) -> bool:
    """Whether one of the outputs is ``-``.

    Raises
    ------
    click.UsageError
        Several are: what would follow what?
    """
    num = sum(is_stdout(path) for path in outputs)
    if num > 1:
        raise click.UsageError("Only one output can be - (stdout); name a file for the others.")
    return num == 1


def write_stdout(content: bytes) -> None:
    """Write to stdout as it is; a reader that left, as ``head`` does, is no error."""
    try:
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        _close_stdout()


def print_page(text: str, *, to_stderr: bool = False) -> None:
    """Print in the encoding of the stream; a reader that left, as ``head`` does, is no error."""
    stream = sys.stderr if to_stderr else sys.stdout
    encoding = stream.encoding or "utf-8"
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)
    except BrokenPipeError:
        _close_stdout()


def terminal_page() -> Page:
    """Return how to draw on stdout: as wide as the terminal; elsewhere as COLUMNS says, or 80 columns."""
    from sfm_audit.reports.text.drawing import Page  # noqa: PLC0415 - rich, for which help and errors need not wait

    is_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size((_WIDTH, 24)).columns if is_terminal else _columns()
    has_colour = is_terminal and "NO_COLOR" not in os.environ
    return Page(width, (sys.stdout.encoding or "").lower().startswith("utf"), has_colour)


def _columns() -> int:
    text = os.environ.get("COLUMNS", "")
    return max(_MIN_WIDTH, int(text)) if text.isascii() and text.isdecimal() and len(text) < 6 else _WIDTH


def _close_stdout() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains when it ends
