"""``sfm-audit diff``: what changed between two runs, for people."""

from __future__ import annotations

from pathlib import Path

import click

from sfm_audit.audit.cli.errors import ExitCode, complain
from sfm_audit.audit.cli.poses import aligned
from sfm_audit.audit.cli.runs import different_settings, read_run, without_poses
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.reports.compare.comparison import compare
from sfm_audit.reports.compare.page import render_comparison


@click.command("diff", short_help="Show what changed between two runs.")
@click.argument("before", metavar="RUN0", type=click.Path(path_type=Path))
@click.argument("after", metavar="RUN1", type=click.Path(path_type=Path))
@click.option("--exit-code", is_flag=True, help="Exit with 1 if anything changed.")
def command(*, before: Path, after: Path, exit_code: bool) -> ExitCode:
    """Show what is different in RUN1: images newly rejected, fixed, lost, added; noise and errors per scene.

    The models are aligned, and images whose cameras are elsewhere then are listed, those that moved together first.
    Images are compared by dataset, scene and name, so that components and ids may be renumbered.

    Exit codes: 0 fine; 1 with --exit-code if anything changed; 3 RUN0 or RUN1 is no finished run.
    """
    runs = [read_run(before), read_run(after)]
    problem = different_settings(runs)
    if problem:
        complain(f"{problem}: verdicts differ for that reason too")
    comparison = compare(runs[0].snapshot, runs[1].snapshot, aligned)
    for note in without_poses(runs):
        complain(note)
    print_page(render_comparison(comparison, (str(before), str(after)), terminal_page()))
    is_changed = any(change.anything for change in comparison.changes)
    return ExitCode.GATE_FAILED if exit_code and is_changed else ExitCode.OK
