"""What does the command line answer with? Exit codes, and errors that are one line for the user."""

from __future__ import annotations

import contextlib
import logging
import sys
from enum import IntEnum
from typing import Final

LOGGER: Final = logging.getLogger("sfm_audit")
LOGGER.addHandler(logging.NullHandler())  # silent, unless --log-file or -v asks
_MAX_CHARACTERS: Final = 900  # of one line


class ExitCode(IntEnum):
    """Contract with scripts that call sfm-audit."""

    OK = 0
    GATE_FAILED = 1
    USAGE = 2  # wrong usage or config; the run folder is in use or holds another run
    UNREADABLE_INPUT = 3  # some input could not be read or holds no model; the rest was audited and written
    OUTPUT = 4  # the output could not be written; finished parts stay
    AUDIT_STOPPED = 5  # a bug or a limit stopped single models; all others were audited and written
    HANGUP = 129  # as shells have it for SIGHUP, SIGINT and SIGTERM
    INTERRUPTED = 130
    TERMINATED = 143


class Ended(BaseException):
    """A signal asked the process to end."""

    def __init__(self, exit_code: ExitCode) -> None:
        super().__init__(exit_code)
        self.exit_code = exit_code


class KnownError(Exception):
    """An error the user can do something about: one line on stderr and an exit code."""

    def __init__(self, message: str, exit_code: ExitCode) -> None:
        super().__init__(message, exit_code)
        self.message = message
        self.exit_code = exit_code

    def __str__(self) -> str:
        return " ".join(self.message.split())


def complain(message: str) -> None:
    """Say something on stderr in one line that is safe to print: names and locations come from others' data."""
    line = " ".join(message.split())
    if len(line) > _MAX_CHARACTERS:
        line = f"{line[: _MAX_CHARACTERS * 2 // 3]} ... {line[-_MAX_CHARACTERS // 3 :]}"
    line = "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in line)
    LOGGER.error("%s", line)
    with contextlib.suppress(OSError):  # the terminal may be gone, as after SIGHUP
        print(f"sfm-audit: {line}", file=sys.stderr, flush=True)
