"""What does the command line answer with? Exit codes, and errors that are one line for the user."""

from __future__ import annotations

from enum import IntEnum


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
