"""``sfm-audit check``: judge a run by a gate file, for a nightly build."""

from __future__ import annotations

import datetime as dt
import importlib.metadata
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click

from sfm_audit.audit.cli.again import Again, with_again
from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.gate_file import read_gate_file
from sfm_audit.audit.cli.poses import aligned
from sfm_audit.audit.cli.runs import (
    ComparedRun,
    read_run,
    read_run_like,
    refuse_different_settings,
    without_poses,
    write_file,
)
from sfm_audit.audit.cli.terminal import one_stdout, print_page, terminal_page
from sfm_audit.reports.compare.comparison import compare
from sfm_audit.reports.compare.gate import Check, judge
from sfm_audit.reports.compare.gate_policy import GatePolicy
from sfm_audit.reports.compare.gate_report import GateReport, render_json
from sfm_audit.reports.compare.junit import render_junit
from sfm_audit.reports.compare.keys import Scope
from sfm_audit.reports.compare.markdown import render_markdown
from sfm_audit.reports.compare.page import OTHER_NAMES, render_gate
from sfm_audit.reports.text.wording import counted

_FILE = click.Path(path_type=Path)
_NOTHING_TO_CHECK: Final = (
    "{gate}: checks nothing: it has no limits, and there is no --baseline; name one (--baseline RUN0), or write "
    "limits, such as limits.min_share_accepted = 0.8 and limits.max_share_rejected = 0.1 (docs/nightly.md)"
)


@click.command("check", short_help="Pass or fail a run by a gate file, for nightly builds.")
@click.argument("run", metavar="RUN", type=_FILE)
@click.option("--policy-file", metavar="GATE.toml", type=_FILE, required=True, help="What is allowed; may be empty.")
@click.option("--baseline", metavar="RUN0", type=_FILE, help="Compare with this run, within the bands of GATE.toml.")
@click.option("--junit", metavar="FILE", type=_FILE, help="Write JUnit XML, for Jenkins and GitLab; - is stdout.")
@click.option("--markdown", metavar="FILE", type=_FILE, help="Write Markdown, for a GitHub step summary.")
@click.option("--json", "json_file", metavar="FILE", type=_FILE, help="Write everything as JSON (docs/nightly.md).")
@with_again
def command(
    *,
    run: Path,
    policy_file: Path,
    baseline: Path | None,
    junit: Path | None,
    markdown: Path | None,
    json_file: Path | None,
    **again: Any,
) -> ExitCode:
    """Judge the run folder RUN by the limits of a gate file, and against a baseline by its bands.

    An empty gate file checks only what --baseline implies: nothing lost, no other camera model, noise and errors not
    larger, images not newly rejected, no new systematic error; docs/nightly.md has the default bands. A baseline of
    another policy is decided again under the settings of RUN.

    A model that a bug or a limit stopped (exit code 5 of run) is a check that failed. Without --baseline the gate file
    must hold limits.

    Exit codes: 0 passed; 1 a check failed; 2 wrong usage or gate file, or runs of different settings; 3 RUN or RUN0 is
    no finished run, or RUN has inputs that could not be read; 4 a report file could not be written.
    """
    is_page_aside = one_stdout([junit, markdown, json_file])
    policy = read_gate_file(policy_file, has_baseline=baseline is not None)
    run_read = read_run(run, Again.of(**again))
    baseline_read = read_run_like(baseline, run_read) if baseline else None
    if baseline_read:
        refuse_different_settings([baseline_read, run_read])
    report = _judged(policy, policy_file, run_read, baseline_read)
    print_page(render_gate(report, terminal_page()), to_stderr=is_page_aside)
    _write_all(
        report, [(junit, render_junit), (markdown, lambda r: render_markdown(r).encode()), (json_file, _json_bytes)]
    )
    if report.unread:
        return ExitCode.UNREADABLE_INPUT
    return ExitCode.OK if report.passed else ExitCode.GATE_FAILED


def _judged(policy: GatePolicy, gate: Path, run: ComparedRun, baseline: ComparedRun | None) -> GateReport:
    comparison = compare(baseline.snapshot, run.snapshot, aligned) if baseline else None
    judged = judge(policy, run.snapshot, comparison)
    if not judged and comparison is None:
        raise KnownError(_NOTHING_TO_CHECK.format(gate=gate), ExitCode.USAGE)
    checks = [*_stopped(run), *judged]
    notes = [f"{each.folder}: {each.decided_again}" for each in (run, baseline) if each and each.decided_again]
    if comparison is not None and comparison.nothing_in_common:
        notes.append(OTHER_NAMES)
    if baseline and (missing := [*baseline.unread, *baseline.stopped]):
        notes.append(
            f"{baseline.folder}: {counted(len(missing), 'input')} of the baseline could not be read or audited, "
            "and nothing is compared with it"
        )
    if baseline and baseline.info.get("version") != run.info.get("version"):
        notes.append(
            f"the baseline was made by sfm-audit {baseline.info.get('version')}, the run by {run.info.get('version')}"
        )
    notes += without_poses([each for each in (baseline, run) if each]) if comparison else []
    return GateReport(
        str(run.folder),
        str(baseline.folder) if baseline else None,
        importlib.metadata.version("sfm-audit"),
        dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S"),
        checks,
        comparison,
        run.unread,
        notes,
    )


def _stopped(run: ComparedRun) -> list[Check]:
    """Return a failed check per model without rows: what nobody audited has not passed."""
    advice = f"tracebacks of bugs are in {run.folder}/errors; give the run command again, it audits what is missing"
    return [
        Check(Scope(), "run.stopped", passed=False, value=None, allowed=None, message=f"{message}; {advice}")
        for _, message in run.stopped
    ]


def _json_bytes(report: GateReport) -> bytes:
    return render_json(report).encode()


def _write_all(report: GateReport, files: list[tuple[Path | None, Callable[[GateReport], bytes]]]) -> None:
    """Write every file that can be written, then complain about the first that cannot."""
    problems = []
    for path, render in files:
        if path is None:
            continue
        try:
            write_file(path, render(report))
        except KnownError as error:
            problems.append(error)
    for problem in problems[1:]:
        complain(str(problem))
    if problems:
        raise problems[0]
