"""``sfm-audit filter``: lists, models and benchmark files without the images that a run rejected."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from sfm_audit.audit.cli.again import Again, with_again
from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.runs import open_run
from sfm_audit.audit.cli.terminal import is_stdout, print_page, write_stdout
from sfm_audit.loaders import LoadError, open_model
from sfm_audit.loaders.scene_info.file import read_scene_info
from sfm_audit.reports.errors import DamagedRunError, OutputError, RunFolderError
from sfm_audit.reports.export.pruned_model import MODEL_FILES, plan_pruning, write_pruned
from sfm_audit.reports.export.scene_info import Match, drop_images, match_images, removed_table, scene_info_bytes
from sfm_audit.reports.export.selection import (
    POSE_SDS,
    AuditedImage,
    Keep,
    as_bytes,
    images_of_model,
    known_to,
    list_text,
    on_side,
    read_images,
    removed_text,
)
from sfm_audit.reports.run_folder.new_files import OutputExistsError, check_free, new_folder, write_file
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.text.wording import counted, plain

_REMOVED: Final = ".removed.csv"
_PATH: Final = click.Path(path_type=Path)


@dataclass(frozen=True, slots=True)
class _Request:
    """What to keep of which run."""

    run: RunReader
    images: tuple[AuditedImage, ...]
    keep: Keep


class _Positive(click.FloatRange):
    """A number above 0; NaN, which no comparison refuses, is none."""

    def __init__(self) -> None:
        super().__init__(min=0, min_open=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"{value} is no number above 0.", param, ctx)
        return number


@click.command("filter", short_help="Write lists, models and benchmark files without the rejected images.")
@click.argument("run_folder", metavar="RUN", type=_PATH)
@click.option(
    "--keep",
    type=click.Choice([keep.value for keep in Keep]),
    default=Keep.NOT_REJECTED.value,
    show_default=True,
    help="Keep all that was not rejected, or only what was accepted.",
)
@click.option(
    "--keep-group",
    type=click.IntRange(1, 2),
    help="Keep this side of folded models (fold_group): the images of the other side go.",
)
@click.option(
    "--max-rotation-sd",
    metavar="DEG",
    type=_Positive(),
    help="Keep images whose rotation is known to that (sd_rotation_deg of run --covariance).",
)
@click.option(
    "--max-centre-sd",
    metavar="X",
    type=_Positive(),
    help="Keep images whose centre is known to that share of the median depth (sd_centre).",
)
@click.option("--list", "list_out", metavar="F", type=_PATH, help="Write the names of the kept images; - is stdout.")
@click.option("--model", metavar="MODEL", type=_PATH, help="A COLMAP model that RUN audited ...")
@click.option("--model-out", metavar="DIR", type=_PATH, help="... and where to write it without the other images.")
@click.option("--scene-info", metavar="F", type=_PATH, help="A scene_info file of LoFTR, D2-Net or glue-factory ...")
@click.option("--scene-info-out", metavar="F", type=_PATH, help="... and where to write it without their pairs.")
@with_again
@click.option("--force", is_flag=True, help="Replace outputs that exist.")
def command(
    *,
    run_folder: Path,
    keep: str,
    keep_group: int | None,
    max_rotation_sd: float | None,
    max_centre_sd: float | None,
    list_out: Path | None,
    model: Path | None,
    model_out: Path | None,
    scene_info: Path | None,
    scene_info_out: Path | None,
    force: bool,
    **again: Any,
) -> ExitCode:
    """Write what the verdicts in the run folder RUN leave of a dataset.

    What was removed, and why, is written beside each output file as <output>.removed.csv. docs/filtering.md says what
    exactly is kept.

    Exit codes: 0 fine; 2 wrong usage, RUN does not hold the model, or an output exists; 3 RUN is none, or the model or
    the scene_info file cannot be read (the other outputs were written); 4 an output could not be written.
    """
    outputs = [path for path in (list_out, model_out, scene_info_out) if path is not None]
    for first, second, name in ((model, model_out, "model"), (scene_info, scene_info_out, "scene-info")):
        if (first is None) != (second is None):
            raise click.UsageError(f"--{name} and --{name}-out belong together.")
    if not outputs:
        raise click.UsageError(
            "Nothing to write: give --list, --model and --model-out, or --scene-info and --scene-info-out."
        )
    _refuse_stdout(model_out, "model-out")
    _refuse_stdout(scene_info_out, "scene-info-out")
    given = [path for path in (run_folder, model, scene_info) if path is not None]
    _check_outputs([path for path in outputs if not is_stdout(path)], given, model_out, force)
    given_sds = zip(POSE_SDS, (max_rotation_sd, max_centre_sd), strict=True)
    sds = {column: limit for column, limit in given_sds if limit is not None}
    request = _open(run_folder, Keep(keep), Again.of(**again), keep_group, sds)
    steps: list[Callable[[], str]] = []
    if list_out is not None:
        steps.append(lambda: _write_list(request, list_out))
    if model is not None and model_out is not None:
        steps.append(lambda: _write_model(request, model, model_out))
    if scene_info is not None and scene_info_out is not None:
        steps.append(lambda: _write_scene_info(request, scene_info, scene_info_out))
    return _run(steps, is_stdout_taken=is_stdout(list_out))


def _refuse_stdout(path: Path | None, name: str) -> None:
    if is_stdout(path):
        raise click.UsageError(f"--{name} cannot be - (stdout): it is written with a list of what was removed.")


def _check_outputs(outputs: Sequence[Path], inputs: Sequence[Path], model_out: Path | None, force: bool) -> None:
    """Refuse outputs that exist, that are an input, or that would replace each other, before anything is read."""
    files = [*outputs, *(_removed_path(path) for path in outputs)]
    real = [os.path.realpath(path) for path in files]
    for path, own in zip(files, real, strict=True):
        if real.count(own) > 1:
            raise KnownError(f"{path}: two outputs would be written there; give each its own name", ExitCode.USAGE)
        if own in {os.path.realpath(given) for given in inputs}:
            raise KnownError(f"{path}: is what is read; write somewhere else", ExitCode.USAGE)
        try:
            check_free(path, force=force, replaceable=MODEL_FILES if path is model_out else frozenset())
        except OutputExistsError as error:
            raise KnownError(str(error), ExitCode.USAGE) from error
        except OutputError as error:
            raise KnownError(str(error), ExitCode.OUTPUT) from error


def _open(run_folder: Path, keep: Keep, again: Again, keep_group: int | None, sds: Mapping[str, float]) -> _Request:
    try:
        run = again.read(open_run(run_folder))
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    try:
        images = known_to(run, read_images(run), sds)
        return _Request(run, images if keep_group is None else on_side(run, images, keep_group), keep)
    except DamagedRunError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.USAGE) from error


def _run(steps: Sequence[Callable[[], str]], *, is_stdout_taken: bool) -> ExitCode:
    """Take each step, whatever becomes of the others; the gravest exit code is the answer."""
    codes = [ExitCode.OK]
    for step in steps:
        try:
            print_page(plain(step()), to_stderr=is_stdout_taken)
            continue
        except LoadError as error:
            message, code = str(error), ExitCode.UNREADABLE_INPUT
        except DamagedRunError as error:
            message, code = str(error), ExitCode.UNREADABLE_INPUT
        except RunFolderError as error:
            message, code = str(error), ExitCode.USAGE
        except OutputError as error:
            message, code = str(error), ExitCode.OUTPUT
        complain(message)
        codes.append(code)
    return max(codes)


def _write_list(request: _Request, out: Path) -> str:
    text = list_text(request.run, request.images, request.keep)
    if is_stdout(out):
        write_stdout(as_bytes(text))
        return f"stdout: {_how_many(request.images, request.keep)}"
    write_file(_removed_path(out), as_bytes(removed_text(_removed(request.images, request.keep))))
    write_file(out, as_bytes(text))
    return f"{out}: {_how_many(request.images, request.keep)}"


def _write_model(request: _Request, model_folder: Path, out: Path) -> str:
    images = images_of_model(request.run, request.images, model_folder)
    model = open_model(model_folder)
    removed = _removed(images, request.keep)
    pruning = plan_pruning(model, {image.image_id for image in removed})
    with new_folder(out) as folder:
        try:
            write_pruned(model, pruning, folder)
        except OSError as error:
            raise OutputError(out, error.strerror or str(error)) from error
        except LoadError as error:
            if not Path(error.path).is_relative_to(folder):
                raise
            reason = f"what was written cannot be read again: found {error.got}"  # pycolmap does not say a full disk
            raise OutputError(out, reason) from error
        write_file(_removed_path(out), as_bytes(removed_text(removed)))
    num_points, num_kept = len(model.points), int(np.count_nonzero(pruning.keeps_point))
    num_cut = int(np.count_nonzero(~pruning.keeps_observation))
    return (
        f"{out}: {_how_many(images, request.keep)}, {num_kept} of {counted(num_points, '3D point')}, "
        f"{num_cut} of {counted(len(model.observations), 'observation')} removed; stored point errors are as they were"
    )


def _write_scene_info(request: _Request, file: Path, out: Path) -> str:
    info = read_scene_info(file)
    matched = match_images(info, request.images, request.keep)
    count = {match: sum(item.match is match for item in matched) for match in Match}
    if matched and count[Match.UNKNOWN] == len(matched):
        problem = f"holds none of the {len(matched)} images of {file}"
        raise RunFolderError(request.run.folder, problem, "name the run over its scene")
    is_removed = np.zeros(len(info.image_paths), dtype=np.bool_)
    is_removed[[item.index for item in matched if item.match is Match.REMOVED]] = True
    filtered = drop_images(info, is_removed)
    content = scene_info_bytes(info, filtered)
    write_file(_removed_path(out), as_bytes(removed_table(matched)))
    write_file(out, content)
    said = f"kept {filtered.num_pairs} of {counted(filtered.num_pairs_before, 'pair')}"
    said += f", {len(matched) - count[Match.REMOVED]} of {counted(len(matched), 'image')}"
    if count[Match.UNKNOWN]:
        said += f"; {counted(count[Match.UNKNOWN], 'image')} of them not in {request.run.folder}"
    if count[Match.AMBIGUOUS]:
        said += f"; {counted(count[Match.AMBIGUOUS], 'image')} of them ambiguous in {request.run.folder}"
    return f"{out}: {said}"


def _removed(images: Sequence[AuditedImage], keep: Keep) -> list[AuditedImage]:
    return [image for image in images if not image.is_kept(keep)]


def _how_many(images: Sequence[AuditedImage], keep: Keep) -> str:
    return f"kept {sum(image.is_kept(keep) for image in images)} of {counted(len(images), 'image')} ({keep})"


def _removed_path(out: Path) -> Path:
    named = Path(os.path.realpath(out)) if out.name in {"", ".."} else out
    if not named.name:
        raise KnownError(f"{out}: cannot be an output; name a file or folder", ExitCode.USAGE)
    return named.with_name(named.name + _REMOVED)
