"""``sfm-audit calibrate``: cameras from 2D-3D correspondences, each validated, compared in one table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.table.words import POLICIES
from sfm_audit.loaders.errors import LoadError
from sfm_audit.reports.errors import OutputError
from sfm_audit.reports.run_folder.new_files import new_folder
from sfm_audit.reports.text.calibration import render_calibration
from sfm_audit.reports.text.drawing import Page

CALIBRATION_FILE: Final = "calibration.parquet"
RESIDUALS_FILE: Final = "residuals.parquet"
SUMMARY_FILE: Final = "summary.txt"
FILES: Final = frozenset({CALIBRATION_FILE, RESIDUALS_FILE, SUMMARY_FILE})
MODELS: Final = ("D1", "D3", "pnprf", "colmap")


def _models(_ctx: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    """Names of estimators, separated by commas, each once."""
    names = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
    unknown = [name for name in names if name not in MODELS]
    if unknown or not names:
        found = ", ".join(unknown) or "none"
        raise click.BadParameter(f"expected some of {', '.join(MODELS)}, found {found}", param=param)
    return names


def _min_effect(_ctx: click.Context, param: click.Parameter, value: str) -> str:
    """A number with its unit, px or sigma, by the rule of the setting of the same name."""
    try:
        return AuditConfig(min_effect=value).min_effect
    except ValueError as error:
        wanted = "expected a number with its unit, such as 0.2px or 0.5sigma"
        raise click.BadParameter(f"{wanted}, found {value!r}", param=param) from error


@click.command("calibrate", short_help="Estimate cameras from 2D-3D correspondences and validate each.")
@click.argument("correspondences", metavar="CORRESPONDENCES")
@click.option(
    "--models", metavar="NAMES", callback=_models, default="D1,D3,pnprf", show_default=True, help="Also: colmap."
)
@click.option("--scan", metavar="SCAN.ptx", help="Gridded lidar scan to take each point's neighbours from.")
@click.option("--image", metavar="PHOTO", type=click.Path(path_type=Path), help="Undistort it by each camera.")
@click.option("--width", type=click.IntRange(min=1), help="Image width, px, where the file does not say it.")
@click.option("--height", type=click.IntRange(min=1), help="Image height, px, where the file does not say it.")
@click.option("--threshold-px", type=click.FloatRange(min=0, min_open=True), default=5.0, show_default=True)
@click.option(
    "--noise",
    type=click.Choice(["auto", "constant", "lidar"]),
    default="auto",
    show_default=True,
    help="auto: lidar where the points have neighbours.",
)
@click.option("--points", type=click.Choice(["independent"]), default="independent", help="The only choice here.")
@click.option("--alpha", type=click.FloatRange(0, 1, min_open=True, max_open=True), default=0.05, show_default=True)
@click.option("--min-effect", metavar="TAU", callback=_min_effect, default="0.5sigma", show_default=True)
@click.option("--policy", type=click.Choice(tuple(POLICIES)), default="full", show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of RANSAC's samples.")
@click.option("-o", "--out", metavar="FOLDER", type=click.Path(path_type=Path), help="Tables and figures.")
@click.option("--force", is_flag=True, help="Replace an earlier calibration in FOLDER.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(*, correspondences: str, out: Path | None, **options: Any) -> ExitCode:
    """Estimate cameras from CORRESPONDENCES, a CSV or Parquet table x, y, X, Y, Z, and say which to believe.

    Each camera is validated as an image of a reconstruction is: is its noise the noise model's, does the lens hold, do
    the points determine it. FOLDER then holds calibration.parquet, residuals.parquet, summary.txt and figures.

    Exit codes: 0 fine, whatever the verdicts; 2 wrong usage, or FOLDER is taken; 3 an input cannot be read; 4 FOLDER
    could not be written.
    """
    if out is not None:
        _refuse_taken(out, force=options["force"])
    with extra("calibrate"):
        from sfm_audit.audit.cli.calibration import Request, calibrate  # noqa: PLC0415 - needs the extra
    config = AuditConfig(
        noise="constant",
        points=options["points"],
        policy=options["policy"],
        alpha=options["alpha"],
        min_effect=options["min_effect"],
    )
    names = ("models", "scan", "image", "width", "height", "threshold_px", "noise", "seed")
    request = Request(correspondences, config, **{name: options[name] for name in names})
    try:
        found = calibrate(request)
    except LoadError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    rows = found.table.to_pylist()
    if out is not None:
        _write(out, {SUMMARY_FILE: render_calibration(rows, request.settings, Page()).encode(), **found.files()})
    if not options["quiet"]:
        print_page(render_calibration(rows, request.settings, terminal_page()))
    return ExitCode.OK


def _refuse_taken(out: Path, *, force: bool) -> None:
    """Let nobody lose a folder that is not an earlier calibration, nor that without asking."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not out.is_dir() or not (out / CALIBRATION_FILE).is_file():
        raise KnownError(f"{out}: is not an earlier calibration; choose a new folder with -o", ExitCode.USAGE)
    foreign = [path.name for path in out.iterdir() if path.name not in FILES and path.suffix != ".png"]
    if foreign:
        raise KnownError(f"{out}: holds {foreign[0]!r} too; choose a new folder with -o", ExitCode.USAGE)
    if not force:
        raise KnownError(f"{out}: holds a calibration; choose another -o, or replace it with --force", ExitCode.USAGE)


def _write(out: Path, files: Mapping[str, bytes]) -> None:
    try:
        with new_folder(out) as folder:
            for name, content in files.items():
                (folder / name).write_bytes(content)
    except (OutputError, OSError) as error:
        problem = error if isinstance(error, OutputError) else OutputError(out, error.strerror or str(error))
        raise KnownError(str(problem), ExitCode.OUTPUT) from error
