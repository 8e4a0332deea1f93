"""``sfm-audit run``: audit the models at and below some PATHs into a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import click

from audit.cli.auditing import RunRequest, print_page, print_summary, run_audit
from audit.cli.errors import ExitCode
from audit.cli.settings import read_config
from audit.config import AuditConfig, NoiseName, PolicyName
from loaders import discover
from loaders.input_state import input_size
from reports.wording import plain

_DEFAULTS = AuditConfig()


@click.command("run", short_help="Audit reconstructions and write the tables into a run folder.")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True)
@click.option("-o", "--out", metavar="RUN", type=click.Path(path_type=Path), help="Folder for the tables.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    help="Processes, each with one model at a time.  [default: CPUs, fewer for little input]",
)
@click.option(
    "--noise",
    type=click.Choice(get_args(NoiseName)),
    help=f"Noise model behind the tests.  [default: {_DEFAULTS.noise}]",
)
@click.option(
    "--policy",
    type=click.Choice(get_args(PolicyName)),
    help=f"Which verdicts decide.  [default: {_DEFAULTS.policy}]",
)
@click.option(
    "--config",
    "config_file",
    metavar="FILE.toml",
    type=click.Path(path_type=Path),
    help="Settings by name (docs/config.md); options of the command line come before them.",
)
@click.option("--list", "only_list", is_flag=True, help="Print the models that were found, audit nothing.")
@click.option("--quiet", is_flag=True, help="No progress and no summary; errors are still said.")
def command(  # one parameter per option
    *, paths: tuple[str, ...], out: Path | None, config_file: Path | None, **options: Any
) -> ExitCode:
    """Audit every model at or below each PATH and write the tables into the folder RUN.

    PATH is a COLMAP model folder, a folder of models such as sparse/, or the root of a dataset. A run that was killed
    goes on where it stopped when the same command is given again; models whose files did not change are not audited
    twice.

    Exit codes: 0 fine; 2 wrong usage or config, or RUN is in use or holds another run; 3 some input could not be read
    (the rest was audited and written); 4 RUN could not be written.
    """
    config = read_config(config_file, {name: options[name] for name in ("noise", "policy")})
    if options["only_list"]:
        return _list(paths)
    if out is None:
        raise click.UsageError("Missing option '-o': the folder for the tables.")
    exit_code = run_audit(RunRequest(paths, out, config, options["jobs"], options["quiet"]))
    if not options["quiet"] and (out / "run.json").exists():
        print_summary(out)
    return exit_code


def _list(paths: tuple[str, ...]) -> ExitCode:
    """Print dataset, scene, component, size in bytes, and location, separated by tabs."""
    found = discover(paths)
    rows = [
        (ref.dataset, ref.scene, ref.component, str(input_size(ref.location)), ref.model_path) for ref in found.refs
    ]
    print_page("\n".join("\t".join(plain(cell) for cell in row) for row in rows))
    for error in found.errors:
        click.echo(f"sfm-audit: {plain(str(error))}", err=True)
    return ExitCode.UNREADABLE_INPUT if found.errors else ExitCode.OK
