"""What is written down while a verb runs: steps on stderr with -v, everything that is said in the file of --log-file.

Lines go through the logger ``sfm_audit``; without these options nobody listens to it.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import click

from sfm_audit.audit.cli.errors import LOGGER, ExitCode, KnownError

_FORMAT: Final = "%(asctime)sZ %(levelname)s %(message)s"


def note(text: str) -> None:
    """Write down a step that only -v and --log-file show."""
    LOGGER.info("%s", text)


def with_journal(command: click.Command) -> click.Command:
    """Add -v and --log-file to a verb, once."""
    if any(param.name == "log_file" for param in command.params):
        return command
    command.params.append(
        click.Option(
            ["--log-file"],
            metavar="FILE",
            type=click.Path(path_type=Path),
            expose_value=False,
            is_eager=True,
            callback=_log_to,
            help="Write steps, errors and exit code there too, behind what it holds.",
        )
    )
    command.params.append(
        click.Option(
            ["-v", "--verbose"],
            is_flag=True,
            expose_value=False,
            is_eager=True,
            callback=_be_verbose,
            help="Say each step on stderr.",
        )
    )
    return command


@contextmanager
def journal() -> Iterator[None]:
    """Take away, at the end of a command, who listens to it."""
    level = LOGGER.level
    try:
        yield
    finally:
        for handler in [each for each in LOGGER.handlers if not isinstance(each, logging.NullHandler)]:
            LOGGER.removeHandler(handler)
            handler.close()
        LOGGER.setLevel(level)


class _Steps(logging.Handler):
    """Steps to stderr, above the progress bar; errors are there anyway."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one line."""
        if record.levelno < logging.WARNING:
            from tqdm import tqdm  # noqa: PLC0415 - only with -v

            line = record.getMessage().encode("unicode_escape").decode()
            tqdm.write(f"sfm-audit: {line}", file=sys.stderr)


class _Lines(logging.Formatter):
    """Times in UTC; what others' data holds stays on its line."""

    converter = staticmethod(time.gmtime)

    def format(self, record: logging.LogRecord) -> str:
        """Return one line, and below it the traceback of a bug."""
        record.msg, record.args = record.getMessage().encode("unicode_escape").decode(), None
        return super().format(record)


def _listen(handler: logging.Handler) -> None:
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)


def _be_verbose(_ctx: click.Context, _param: click.Parameter, value: bool) -> None:
    if value:
        _listen(_Steps())


def _log_to(_ctx: click.Context, _param: click.Parameter, value: Path | None) -> None:
    if value is None:
        return
    if value.is_dir():
        raise KnownError(f"{value}: is a folder; name a file for --log-file", ExitCode.USAGE)
    try:
        handler = logging.FileHandler(value, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        problem = f"{value}: cannot be written ({error.strerror}); choose another --log-file"
        raise KnownError(problem, ExitCode.OUTPUT) from error
    handler.setFormatter(_Lines(_FORMAT, "%Y-%m-%dT%H:%M:%S"))
    _listen(handler)
