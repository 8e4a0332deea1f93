"""``sfm-audit diagnose``: why the models of a run are judged as they are, and what a refit would do."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
from tqdm import tqdm

from sfm_audit.audit.cli.diagnose_json import diagnosis_bytes, model_as_json
from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.runs import open_run, write_file
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.cli.terminal import is_stdout, print_page, terminal_page
from sfm_audit.audit.table import TABLES
from sfm_audit.audit.table.diagnoses import DiagnosisCode
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.reports.charts import ResidualError
from sfm_audit.reports.errors import OutputError, RunFolderError
from sfm_audit.reports.run_folder.new_files import new_folder
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.evidence import EvidenceText, render_evidence
from sfm_audit.reports.text.wording import plain

MAX_IMAGES: Final = 300  # of a model that is refitted unasked: adjusting takes minutes beyond


@click.command("diagnose", short_help="Say why models are judged as they are; try refits.")
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@click.argument("model", metavar="[MODEL]", required=False)
@click.option(
    "--as", "wanted", metavar="CAMERA_MODEL", multiple=True, help="Refit as this. Repeatable.  [default: advised]"
)
@click.option("--refit/--no-refit", default=None, help=f"Refit.  [default: models of up to {MAX_IMAGES} images]")
@click.option("--out", metavar="DIR", type=click.Path(path_type=Path), help="Write the model refitted --as here.")
@click.option(
    "--json", "json_file", metavar="FILE", type=click.Path(path_type=Path), help="Write all as JSON; - is stdout."
)
@click.option("--quiet", is_flag=True, help="No progress; errors are still said.")
def command(  # one parameter per option
    *, run_folder: Path, model: str | None, wanted: tuple[str, ...], refit: bool | None, out: Path | None, **output: Any
) -> ExitCode:
    """Say what the residuals of the models in RUN tell beyond the tables, and what adjusting them again would do.

    MODEL is a scene, scene/component or location of RUN; without, all models that are not sound. Each is opened where
    it lies as RUN read it. It is adjusted by pycolmap as it is, which is the control, and with the camera models that
    are advised (else, or where none of these helps, with larger ones), then audited again with the settings of RUN.

    Exit codes: 0 fine; 2 wrong usage, or RUN holds no such model; 3 RUN or a model cannot be read; 4 DIR or FILE could
    not be written.
    """
    _refuse(wanted, refit, out)
    json_file: Path | None = output["json_file"]
    if json_file is not None and json_file.is_dir():
        raise KnownError(f"{json_file}: is a folder; name a file for --json", ExitCode.USAGE)
    quiet, is_page_aside = bool(output["quiet"]), is_stdout(json_file)
    try:
        run = open_run(run_folder, quiet=quiet)
        chosen = _chosen(run, model)
        if out is not None and len(chosen) != 1:
            raise KnownError(f"--out takes one MODEL, {len(chosen)} are meant; name one", ExitCode.USAGE)
        shown = tqdm(chosen, unit="model", disable=quiet or not sys.stderr.isatty())
        named = [model] if model else []
        told = []
        for row in shown:
            told.append(_diagnose(run, row, wanted, refit=refit, out=out, named=named))
            if told[-1]["problem"] is None:
                print_page(_page(run, row, told[-1]), to_stderr=is_page_aside)
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    except OutputError as error:
        raise KnownError(str(error), ExitCode.OUTPUT) from error
    if not chosen:
        said = f"{plain(str(run_folder))}: nothing speaks against any of its {run.num_models} models"
        print_page(said, to_stderr=is_page_aside)
    if json_file is not None:
        write_file(json_file, diagnosis_bytes(run_folder, told))
    return ExitCode.UNREADABLE_INPUT if any(each["problem"] for each in told) else ExitCode.OK


def _refuse(wanted: tuple[str, ...], refit: bool | None, out: Path | None) -> None:
    unknown = [name for name in wanted if name not in BY_NAME]
    if unknown:
        hint = did_you_mean(unknown[0], BY_NAME) or f"; one of {', '.join(BY_NAME)}"
        raise KnownError(f"--as {plain(unknown[0])}: no camera model{hint}", ExitCode.USAGE)
    if out is not None and len(wanted) != 1:
        raise KnownError("--out takes one --as CAMERA_MODEL: the model that is written", ExitCode.USAGE)
    if out is not None and os.path.lexists(out) and not (out.is_dir() and not any(out.iterdir())):
        raise KnownError(f"{out}: exists; choose a new folder with --out", ExitCode.USAGE)
    if refit is False and (wanted or out is not None):
        raise KnownError("--no-refit contradicts --as and --out", ExitCode.USAGE)


def _chosen(run: RunReader, model: str | None) -> list[Row]:
    """Return the rows of the models that are meant."""
    rows = list(run.rows("models", [column.name for column in TABLES["models"]]))
    if model is None:
        return [row for row in rows if _codes(row) - {str(DiagnosisCode.SOUND)}]
    named = [r for r in rows if model in (r["model_path"], f"{r['scene']}/{r['component']}", r["scene"])]
    if not named:
        known = ", ".join(plain(f"{row['scene']}/{row['component']}") for row in rows[:3])
        raise KnownError(f"{run.folder}: holds no model {plain(model)!r}; it holds {known} ...", ExitCode.USAGE)
    return named


def _codes(row: Row) -> set[str]:
    return {str(each["code"]) for each in row.get("diagnoses") or []}


def _diagnose(
    run: RunReader, row: Row, wanted: tuple[str, ...], *, refit: bool | None, out: Path | None, named: list[str]
) -> dict[str, Any]:
    """Return what `model_as_json` says of a model; a model that cannot be read is complained of."""
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 - help and errors import nothing that audits

    from sfm_audit.audit.cli.recompute import ResidualSource  # noqa: PLC0415
    from sfm_audit.audit.diagnose.model import diagnose_model  # noqa: PLC0415
    from sfm_audit.audit.diagnose.refit import with_cameras  # noqa: PLC0415

    try:
        auditor = ResidualSource(run, named).auditor(row["model_path"])
    except ResidualError as error:
        complain(f"{row['model_path']}: not diagnosed: {error}")
        return model_as_json(row, None, str(error))
    unfit = [name for name in wanted if with_cameras(auditor.model, name) is None]
    if unfit:
        raise KnownError(f"--as {unfit[0]}: cannot express the cameras of {row['model_path']}", ExitCode.USAGE)
    tables = {name: _rows_of(run, name, row["model_path"]) for name in ("images", "cameras")}
    refitted = refit if refit is not None else bool(wanted) or len(tables["images"]) <= MAX_IMAGES
    diagnose = partial(
        diagnose_model, auditor, tables["images"], tables["cameras"], _codes(row), refitted=refitted, wanted=wanted
    )
    with threadpool_limits(limits=1, user_api="blas"), ExitStack() as stack:
        found = diagnose(out=None if out is None else stack.enter_context(new_folder(out)))
        failed = [each.problem for each in found.refits[1:] if each.problem is not None]
        if out is not None and (failed or not found.refits):
            problem = failed[0] if failed else found.conclusion
            raise KnownError(f"{out}: nothing was written: {problem}", ExitCode.OUTPUT)
    return model_as_json(row, found, None)


def _page(run: RunReader, row: Row, told: dict[str, Any]) -> str:
    text = EvidenceText(told["readings"], [each["reading"] for each in told["refits"]], told["conclusion"])
    return render_evidence(row, text, run.folder, terminal_page().width)


def _rows_of(run: RunReader, table: str, model_path: str) -> list[Row]:
    columns = [column.name for column in TABLES[table]]  # type: ignore[index]
    for _, rows in run.parts(table, columns):
        if rows and rows[0]["model_path"] == model_path:
            return rows
    return []
