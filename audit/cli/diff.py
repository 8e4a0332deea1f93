"""``sfm-audit diff``: what changed between two runs, for people."""

from __future__ import annotations

from pathlib import Path

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.cli.poses import aligned
from sfm_audit.audit.cli.runs import ComparedRun, different_settings, read_run, read_run_like, without_poses
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.reports.compare.comparison import Comparison, compare
from sfm_audit.reports.compare.page import render_comparison
from sfm_audit.reports.errors import OutputError
from sfm_audit.reports.run_folder.new_files import OutputExistsError, check_free, write_file


@click.command("diff", short_help="Show what changed between two runs.")
@click.argument("before", metavar="RUN0", type=click.Path(path_type=Path))
@click.argument("after", metavar="RUN1", type=click.Path(path_type=Path))
@click.option("--exit-code", is_flag=True, help="Exit with 1 if anything changed.")
@click.option("--html", "page", metavar="FILE", type=click.Path(path_type=Path), help="Write an HTML page too.")
@click.option("--force", is_flag=True, help="Replace the page if it is there.")
def command(*, before: Path, after: Path, exit_code: bool, page: Path | None, force: bool) -> ExitCode:
    """Show what is different in RUN1: images newly rejected, fixed, lost, added; noise and errors per scene.

    The models are aligned, and images whose cameras are elsewhere then are listed, those that moved together first.
    Images are compared by dataset, scene and name, so that components and ids may be renumbered. Where the policy
    or another setting that only decides differs, RUN0 is decided again under the settings of RUN1.

    Exit codes: 0 fine; 1 with --exit-code if anything changed; 2 the page exists, or RUN0 cannot be decided as RUN1
    was; 3 RUN0 or RUN1 is no finished run; 4 the page could not be written.
    """
    if page is not None:
        _refuse_taken(page, force=force)
    last = read_run(after)
    runs = [read_run_like(before, last), last]
    if runs[0].decided_again:
        complain(f"{before}: {runs[0].decided_again}, as {after}")
    problem = different_settings(runs)
    if problem:
        complain(f"{problem}: verdicts differ for that reason too")
    comparison = compare(runs[0].snapshot, runs[1].snapshot, aligned)
    for note in without_poses(runs):
        complain(note)
    print_page(render_comparison(comparison, (str(before), str(after)), terminal_page()))
    if page is not None:
        _write_page(page, comparison, (runs[0], runs[1]), problem)
    is_changed = any(change.anything for change in comparison.changes)
    return ExitCode.GATE_FAILED if exit_code and is_changed else ExitCode.OK


def _refuse_taken(page: Path, *, force: bool) -> None:
    try:
        check_free(page, force=force)
    except OutputExistsError as error:
        raise KnownError(str(error), ExitCode.USAGE) from error


def _write_page(page: Path, comparison: Comparison, runs: tuple[ComparedRun, ComparedRun], note: str | None) -> None:
    with extra("report"):
        from sfm_audit.reports.html.diff import ComparedInfo, render_diff  # noqa: PLC0415 - needs the extra
    before, after = (ComparedInfo(str(run.folder), run.info) for run in runs)
    try:
        write_file(page, render_diff(comparison, (before, after), note).encode())
    except OutputError as error:
        raise KnownError(str(error), ExitCode.OUTPUT) from error
