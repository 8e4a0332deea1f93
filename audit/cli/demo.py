"""``sfm-audit demo``: simulate photos with planted defects, audit them, say which defects were found."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import click
import numpy as np

from sfm_audit.audit.cli.auditing import RunRequest, print_summary, run_audit
from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.finding import Wanted, find_models
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.simulate.demo import TruthRecord, demo_scene, truth_records
from sfm_audit.audit.simulate.scene import simulate_scene
from sfm_audit.audit.table.words import POLICIES, Member, ReasonCode, Verdict, is_remark, verdict_under
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.drawing import Field, Listing, draw
from sfm_audit.reports.text.wording import MISSING, counted, paragraph

TRUTH_FILE: Final = "truth.json"
MARK: Final = "sfm-audit demo"
IMAGE_COLUMNS: Final = (
    *("image_name", "num_inliers", "verdict", *map(str, Member), "reasons"),
    *("misfit_group", "misfit_px", "advised_camera_model"),
)
NOT_REGISTERED: Final = {**dict.fromkeys(IMAGE_COLUMNS), "verdict": "not registered"}
TOO_LITTLE: Final = frozenset({ReasonCode.TOO_FEW_OBSERVATIONS, ReasonCode.LOW_COVERAGE, ReasonCode.FEW_OCCUPIED_CELLS})
SHORT_WORDS: Final[dict[str, str]] = {DefectKind.RADIAL_K2: "k2 missing", DefectKind.PERTURBED_POSE: "pose moved"}


@click.command("demo", short_help="Audit simulated photos with planted defects; needs no data.")
@click.option("-o", "--out", type=click.Path(path_type=Path), default=Path("audit-demo"), show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, other photos.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(*, out: Path, seed: int, quiet: bool) -> ExitCode:
    """Simulate a photo collection with known truth, audit it, and compare the verdicts with what was planted.

    The folder then holds the reconstruction (photos/sparse/0), the truth (truth.json) and the run folder (run). An
    earlier demo in it is replaced.
    """
    _refuse_foreign_folder(out)
    _say(quiet, f"Simulating and adjusting a photo collection (seed {seed}) ...")
    truth = _simulate(out, seed)
    paths = [str(out / "photos")]
    exit_code = run_audit(
        RunRequest(paths, out / "run", AuditConfig(), jobs=1, quiet=quiet), find_models(paths, Wanted())
    )
    if not quiet:
        print_summary(out / "run")
        print_page(_comparison(RunReader.open(out / "run"), truth))
    return exit_code


def _simulate(out: Path, seed: int) -> list[TruthRecord]:
    scene = simulate_scene(demo_scene(seed), np.random.default_rng([seed, 1]))
    truth = truth_records(scene)
    content = {"made_by": MARK, "seed": seed, "defects": [asdict(record) for record in truth]}
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / TRUTH_FILE).write_text(json.dumps(content, indent=1), encoding="utf-8")
        write_adjusted_model(scene, out / "photos" / "sparse" / "0")
    except OSError as error:
        raise KnownError(f"{out}: cannot be written ({error.strerror}); choose another -o", ExitCode.OUTPUT) from error
    return truth


def _refuse_foreign_folder(out: Path) -> None:
    """Let nobody lose a folder that is not an earlier demo."""
    if out.exists() and not out.is_dir():
        raise KnownError(f"{out}: is a file, and a demo is a folder; choose another -o", ExitCode.OUTPUT)
    if not out.is_dir() or not any(out.iterdir()):
        return
    try:
        mark = json.loads((out / TRUTH_FILE).read_bytes())["made_by"]
    except (OSError, ValueError, KeyError, TypeError):
        mark = None
    if mark != MARK:
        problem = f"{out}: not empty and not an earlier demo; choose another folder with -o"
        raise KnownError(problem, ExitCode.USAGE)


def _comparison(run: RunReader, truth: Sequence[TruthRecord]) -> str:
    """Return the table of planted defects, what is not found and why, and the false alarms among the sound images."""
    page = terminal_page()
    images = {row["image_name"]: row for row in run.rows("images", IMAGE_COLUMNS)}
    planted = [_compared(record, images.get(record.image_name, NOT_REGISTERED)) for record in truth]
    planted.sort(key=lambda row: (row["defect"], row["size_px"] or 0, row["image_name"]))
    fields = [
        Field("planted", lambda r: r["planted"], numeric=False),
        Field("verdict", lambda r: r["verdict"], numeric=False),
        Field("found", lambda r: "yes" if r["found"] else "NO", lambda r: "green" if r["found"] else "red"),
        Field("because", lambda r: r["because"], numeric=False),
        Field("advice", lambda r: r["advised_camera_model"] or MISSING, numeric=False),
    ]
    names = [[row["image_name"]] for row in planted]
    table = draw(Listing("Planted defects against verdicts", "image", names, planted), fields, page)
    sound = [row for name, row in images.items() if name not in {record.image_name for record in truth}]
    lines = [
        f"{sum(row['found'] for row in planted)} of {counted(len(planted), 'planted defect')} found.",
        *(_why_not_found(row, run.info["config"]["min_effect"]) for row in planted if not row["found"]),
        *_false_alarms(sound),
        (
            "What no verdict can find: a pose that was adjusted together with its error (it is at its optimum), a "
            f"misfit below {run.info['config']['min_effect']} (--min-effect); and without witnesses outside of the "
            "images (docs/witnesses.md) symmetric mis-registration, global scale, drift."
        ),
    ]
    return "\n".join([table, *(paragraph(line, page.width) for line in lines)])


def _compared(record: TruthRecord, row: Row) -> Row:
    """Return what was planted in an image beside what the audit says about it."""
    codes = [reason.split(":", 1)[0] for reason in row["reasons"] or []]
    is_few = record.defect == DefectKind.FEW_POINTS
    found = row["verdict"] == Verdict.REJECTED or (
        is_few and row["verdict"] == Verdict.UNDETERMINED and not TOO_LITTLE.isdisjoint(codes)
    )
    planted = record.words.partition(",")[0] if is_few else f"{SHORT_WORDS[record.defect]}, {record.size_px:.2f} px"
    if row["misfit_group"] is not None:
        because = f"{row['misfit_group']} {row['misfit_px']:.2f} px"
    else:
        because = next((code for code in codes if not is_remark(code, row)), MISSING)
    return {**row, **asdict(record), "planted": planted, "found": found, "because": because}


def _why_not_found(row: Row, min_effect: str) -> str:
    """Say in one sentence why a planted defect is not found."""
    what = f"{row['image_name']} is not found: "
    if row["misfit_group"] is not None:
        return f"{what}{row['because']} is there, but below what matters ({min_effect}, --min-effect)."
    if row["verdict"] == Verdict.ACCEPTED:
        return f"{what}the defect is not significant in {row['num_inliers']} inliers."
    return f"{what}{row['verdict']} for another reason ({row['because']})."


def _false_alarms(sound: Sequence[Row]) -> list[str]:
    """Count the sound images that are rejected, by policy."""
    rejected = {policy: sum(verdict_under(policy, row) == Verdict.REJECTED for row in sound) for policy in POLICIES}
    counts = ", ".join(f"{num} {policy}" for policy, num in rejected.items())
    lines = [f"Of {counted(len(sound), 'sound image')} rejected (false alarms), by policy: {counts}."]
    if rejected["paper"]:
        lines.append(
            "KS judges the noise: here it differs from track to track, and where the noise model did not quite predict "
            "it, KS rejects an image whose camera is right. Policy standard asks for a difference that can be seen."
        )
    return lines


def _say(quiet: bool, text: str) -> None:
    if not quiet and sys.stderr.isatty():
        click.echo(text, err=True)
