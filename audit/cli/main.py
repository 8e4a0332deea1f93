"""The command ``sfm-audit``: its verbs, each imported when it is used, and what an error means for the exit code."""

from __future__ import annotations

import importlib
import signal
import sys
import traceback
from collections.abc import Sequence
from functools import partial
from typing import Final, cast

import click

from sfm_audit.audit.cli.errors import LOGGER, Ended, ExitCode, KnownError, complain
from sfm_audit.audit.cli.journal import journal, note, with_journal
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.schedule.garbage import importing, leaving
from sfm_audit.audit.schedule.memory import keep_freed

VERBS: Final = {
    "run": "Audit reconstructions and write the tables into a run folder.",
    "report": "Write one HTML page about a run, to look at and to send.",
    "explain": "Tell one image's whole story, as text and pictures.",
    "diagnose": "Say why models are judged as they are; try refits.",
    "explain-code": "Say what a reason code or finding means, and what to do.",
    "check": "Pass or fail a run by a gate file, for nightly builds.",
    "learn-band": "Learn what repeated reconstructions differ by, as a gate file.",
    "diff": "Show what changed between two runs.",
    "filter": "Write lists, models and benchmark files without the rejected images.",
    "calibrate": "Estimate cameras from 2D-3D correspondences and validate each.",
    "simulate": "Write 2D-3D correspondences with known truth.",
    "demo": "Audit simulated photos with planted defects; needs no data.",
}


_SIGNALS: Final = {"SIGTERM": ExitCode.TERMINATED, "SIGHUP": ExitCode.HANGUP}
_GOES_ON: Final = "what was finished stays, the same command goes on"
_NO_MEMORY: Final = "there is not enough memory for this; name less at a time, or give the process more memory"
_WORDS: Final = {
    ExitCode.INTERRUPTED: f"interrupted; {_GOES_ON}",
    ExitCode.TERMINATED: f"ended by SIGTERM; {_GOES_ON}",
    ExitCode.HANGUP: f"ended by SIGHUP; {_GOES_ON}",
}


class LazyGroup(click.Group):
    """A group whose verbs live in audit/cli/<verb>.py and are imported when they are called, not for --help."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the verbs in the order in which a newcomer meets them."""
        del ctx
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one verb."""
        del ctx
        if cmd_name not in VERBS:
            return None
        with importing():
            module = importlib.import_module(f"sfm_audit.audit.cli.{cmd_name.replace('-', '_')}")
        return with_journal(cast("click.Command", module.command))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the verb, or say which one was probably meant."""
        if args[0] not in VERBS and not args[0].startswith("-"):
            known = ", ".join(VERBS)
            hint = did_you_mean(args[0], VERBS) or f"; the commands are {known}"
            ctx.fail(f"No such command {args[0]!r}{hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing them."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl(list(VERBS.items()))


def _version() -> str:
    from importlib.metadata import version  # noqa: PLC0415 - takes as long as click

    return version("sfm-audit")


def _say_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if not asked or context.resilient_parsing:
        return
    from sfm_audit.audit.kernels import path_taken  # noqa: PLC0415 - imports numpy

    path = path_taken()
    click.echo(f"sfm-audit {_version()}\nnumbers by {path} ({path.reason})")
    context.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_say_version,
    help="Say the version, and whether numbers come from compiled kernels.",
)
def cli() -> None:
    """Say which images of a structure-from-motion reconstruction to trust, and why not the others."""


def main(args: Sequence[str]) -> int:
    """Run one command and return its exit code; errors nobody expected keep their traceback."""
    with journal():
        try:
            code = _answer(args)
        except Exception:
            LOGGER.exception("a bug in sfm-audit %s", _version())
            raise
        note(f"exit code {code}")
        return code


def _answer(args: Sequence[str]) -> int:
    """Run one command; a known error is one line."""
    try:
        code = cli.main(list(args) or ["--help"], prog_name="sfm-audit", standalone_mode=False, obj=tuple(args))
    except KnownError as error:
        return _refuse(str(error), error.exit_code)
    except click.Abort:
        return _refuse(_WORDS[ExitCode.INTERRUPTED], ExitCode.INTERRUPTED)
    except Ended as ended:
        return _refuse(_WORDS[ended.exit_code], ended.exit_code)
    except MemoryError:
        LOGGER.exception("out of memory")
        return _refuse(_NO_MEMORY, ExitCode.AUDIT_STOPPED)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        advice = f" (see {context.command_path} --help)" if context else ""
        return _refuse(error.format_message() + advice, ExitCode.USAGE)
    return int(code or 0)


def entry_point() -> None:
    """Run the command that the shell gave; a signal that asks for the end ends it as an interrupt does."""
    for name, code in _SIGNALS.items():
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores SIGHUP, and so do we
            signal.signal(number, partial(_end, code))
    keep_freed()
    try:
        exit_code = main(sys.argv[1:])
    except Exception:  # noqa: BLE001 - a bug; Python's own exit code for it, 1, would say that a gate failed
        traceback.print_exc()
        exit_code = int(ExitCode.AUDIT_STOPPED)
    leaving()
    sys.exit(exit_code)


def _end(code: ExitCode, number: int, frame: object) -> None:
    del frame
    signal.signal(number, signal.SIG_DFL)  # a second one does not wait for us to clean up
    raise Ended(code)


def _refuse(message: str, exit_code: ExitCode) -> int:
    complain(message)
    return int(exit_code)
