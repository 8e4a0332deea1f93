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

from audit.cli.auditing import RunRequest, print_page, print_summary, run_audit, terminal_page
from audit.cli.errors import ExitCode, KnownError
from audit.config import AuditConfig
from audit.simulate.adjust import write_adjusted_model
from audit.simulate.demo import TruthRecord, demo_scene, truth_records
from audit.simulate.scene import simulate_scene
from audit.verdict import ReasonCode, Verdict
from reports.drawing import Field, Listing, draw
from reports.reader import Row, RunReader
from reports.wording import counted, paragraph

TRUTH_FILE: Final = "truth.json"
MARK: Final = "sfm-audit demo"


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
    exit_code = run_audit(RunRequest([str(out / "photos")], out / "run", AuditConfig(), jobs=1, quiet=quiet))
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
    """Return the table of planted defects, and the false alarms among the sound images."""
    page = terminal_page()
    images = {row["image_name"]: row for row in run.rows("images", ("image_name", "verdict", "reasons"))}
    planted = [{**asdict(record), **_verdict_on(record, images)} for record in truth]
    planted.sort(key=lambda row: (row["defect"], row["size_px"] or 0, row["image_name"]))
    fields = [
        Field("what was planted", lambda r: r["words"].replace(" px RMS", " px"), numeric=False),
        Field("verdict", lambda r: r["verdict"], numeric=False),
        Field("found", lambda r: "yes" if r["found"] else "NO", lambda r: "green" if r["found"] else "red"),
    ]
    names = [[row["image_name"]] for row in planted]
    table = draw(Listing("Planted defects against verdicts", "image", names, planted), fields, page)
    found = sum(row["found"] for row in planted)
    sound = [row for name, row in images.items() if name not in {record.image_name for record in truth}]
    alarms = sum(row["verdict"] == Verdict.REJECTED for row in sound)
    lines = [
        f"{found} of {counted(len(planted), 'planted defect')} found.",
        f"{alarms} of {counted(len(sound), 'sound image')} rejected (false alarms).",
        (
            "KS judges the distribution of the noise. A lens that bends a little more than its model, or a pose that "
            "was moved, hides in it; the tests that look for those are not part of this version."
        ),
    ]
    return "\n".join([table, *(paragraph(line, page.width) for line in lines)])


def _verdict_on(record: TruthRecord, images: dict[str, Row]) -> Row:
    row = images.get(record.image_name, {"verdict": "not registered", "reasons": []})
    codes = {reason.split(":", 1)[0] for reason in row["reasons"] or []}
    undetermined = row["verdict"] == Verdict.UNDETERMINED and ReasonCode.TOO_FEW_OBSERVATIONS in codes
    return {"verdict": row["verdict"], "found": row["verdict"] == Verdict.REJECTED or undetermined}


def _say(quiet: bool, text: str) -> None:
    if not quiet and sys.stderr.isatty():
        click.echo(text, err=True)
