"""``sfm-audit run``: audit the models at and below some PATHs into a run folder."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from sfm_audit.audit.cli.errors import ExitCode, complain
from sfm_audit.audit.cli.finding import (
    CHOICE_OF_MODELS,
    find_models,
    listed,
    refuse_lost,
    wanted_of,
    with_choice_of_models,
)
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.cli.terminal import print_page, write_stdout
from sfm_audit.audit.config import AuditConfig, NoiseName, PointsName
from sfm_audit.audit.schedule.imports import importing_audits
from sfm_audit.audit.table.words import POLICIES

if TYPE_CHECKING:
    from sfm_audit.audit.schedule.task import Limits

_DEFAULTS = AuditConfig()
_SETTINGS = ("noise", "points", "min_effect", "policy", "database", "covariance", "reference", "priors")


@click.command("run", short_help="Audit reconstructions and write the tables into a run folder.")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True)
@click.option("-o", "--out", metavar="RUN", type=click.Path(path_type=Path), help="Folder for the tables.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    help="Processes; a large model is spread over several.  [default: CPUs, fewer for little input]",
)
@click.option(
    "--dask",
    metavar="ADDRESS|local",
    help="Audit on the workers of this Dask scheduler (tcp://HOST:PORT), or of one on this machine.",
)
@click.option(
    "--noise",
    type=click.Choice(get_args(NoiseName)),
    help=f"Noise model behind the tests.  [default: {_DEFAULTS.noise}]",
)
@click.option(
    "--points",
    type=click.Choice(get_args(PointsName)),
    help=f"Were the 3D points triangulated from these images?  [default: {_DEFAULTS.points}]",
)
@click.option(
    "--min-effect",
    metavar="TAU",
    help=f"Misfit that matters, such as 0.2px or 0.5sigma.  [default: {_DEFAULTS.min_effect}]",
)
@click.option(
    "--database",
    metavar="DB|auto",
    help="Ask the verified pairs of this database.db, or of the one beside or above each model.",
)
@click.option(
    "--covariance",
    is_flag=True,
    default=None,
    help="Say how well every pose is known: sd_rotation_deg, sd_centre and others.",
)
@click.option(
    "--reference",
    metavar="POSES",
    help="Compare with poses known otherwise: a model, a tree of models, a trajectory (TUM, KITTI, EuRoC), an IMC CSV.",
)
@click.option(
    "--priors",
    metavar="auto|FILE",
    help="Ask position priors: of the database.db of each model (auto), or of a CSV or database.",
)
@click.option(
    "--policy",
    type=click.Choice(tuple(POLICIES)),
    help=f"Which verdicts decide.  [default: {_DEFAULTS.policy}]",
)
@click.option(
    "--config",
    "config_file",
    metavar="FILE.toml",
    type=click.Path(path_type=Path),
    help="Settings by name (docs/config.md); options of the command line come before them.",
)
@with_choice_of_models
@click.option(
    "--max-model-gb",
    metavar="GB",
    type=click.FloatRange(min=0, min_open=True),
    help="Refuse to load a model whose files are larger.  [default: no limit]",
)
@click.option(
    "--max-model-memory",
    metavar="GB",
    type=click.FloatRange(min=0, min_open=True),
    help="End the audit of a model whose process takes more memory.  [default: no limit]",
)
@click.option(
    "--max-model-seconds",
    metavar="S",
    type=click.FloatRange(min=0, min_open=True),
    help="End the audit of a model that takes longer.  [default: no limit]",
)
@click.option("--verify", is_flag=True, help="Read all inputs again, where otherwise size and time of change count.")
@click.option("--observations", is_flag=True, help="Write RUN/observations too, one row per inlier.")
@click.option("--list", "only_list", is_flag=True, help="Print the models that were found, audit nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print counts and failures as JSON instead of the summary.")
@click.option("--quiet", is_flag=True, help="No progress and no summary; errors are still said.")
def command(  # one parameter per option
    *, paths: tuple[str, ...], out: Path | None, config_file: Path | None, **options: Any
) -> ExitCode:
    """Audit every model at or below each PATH and write the tables into the folder RUN.

    PATH is a COLMAP model folder, a folder of models such as sparse/, or the root of a dataset. A run that was killed
    goes on where it stopped when the same command is given again; models whose files did not change are not audited
    twice.

    Exit codes: 0 fine; 2 wrong usage or config, or RUN is in use or holds another run; 3 some input could not be read
    (the rest was audited and written); 4 RUN could not be written; 5 a bug or a limit stopped single models (traceback
    in RUN/errors, all others were audited). Of 2 to 5 the highest that applies.
    """
    config = read_config(config_file, {name: options[name] for name in _SETTINGS})
    _refuse_lost(config)
    wanted = wanted_of(**{name: options[name] for name in CHOICE_OF_MODELS})
    if options["only_list"] and options["as_json"]:
        raise click.UsageError("--list and --json exclude each other; --list is a table with tabs.")
    if out is None and not options["only_list"]:
        raise click.UsageError("Missing option '-o': the folder for the tables.")
    found = find_models(paths, wanted)
    if out is None or options["only_list"]:
        lines, problems = listed(found)
        print_page("\n".join(lines))
        return _refuse(problems)
    if not found.refs:
        exit_code = _refuse([str(error) for error in found.errors])
        if options["as_json"]:
            _print_json(out, exit_code)
        return exit_code
    with importing_audits():  # half a second: --help and a wrong option, config or PATH need not wait for it
        from sfm_audit.audit.cli.auditing import RunRequest, print_summary, run_audit  # noqa: PLC0415

    request = RunRequest(
        paths,
        out,
        config,
        options["jobs"],
        options["quiet"],
        options["observations"],
        options["dask"],
        _limits(options["max_model_gb"], options["max_model_memory"], options["max_model_seconds"]),
        options["verify"],
    )
    exit_code = run_audit(request, found)
    if options["as_json"]:
        _print_json(out, exit_code)
    elif not options["quiet"] and (out / "run.json").exists():
        print_summary(out)
    return exit_code


def _refuse_lost(config: AuditConfig) -> None:
    refuse_lost("--database", config.database, folder="name the database.db in it, or auto")
    refuse_lost("--reference", config.reference)
    refuse_lost("--priors", config.priors, folder="name the CSV or database in it, or auto")


def _print_json(folder: Path, exit_code: ExitCode) -> None:
    from sfm_audit.audit.cli.run_json import run_as_json  # noqa: PLC0415 - as above

    write_stdout(run_as_json(folder, exit_code))


def _refuse(problems: Sequence[str]) -> ExitCode:
    for problem in problems:
        complain(problem)
    return ExitCode.UNREADABLE_INPUT if problems else ExitCode.OK


def _limits(input_gb: float | None, memory_gb: float | None, seconds: float | None) -> Limits:
    from sfm_audit.audit.schedule.task import Limits  # noqa: PLC0415 - as above

    if memory_gb is not None and not Path("/proc/self/statm").exists():
        raise click.UsageError("--max-model-memory: this operating system does not say how much a process has.")
    return Limits(_bytes(input_gb), _bytes(memory_gb), seconds)


def _bytes(gigabytes: float | None) -> int | None:
    return None if gigabytes is None else int(min(gigabytes * 1e9, sys.maxsize))
