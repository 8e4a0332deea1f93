"""``sfm-audit explain``: one image's whole story as text and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, get_args

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.cli.terminal import print_page
from sfm_audit.audit.config import NoiseName, PointsName
from sfm_audit.audit.table.words import POLICIES
from sfm_audit.loaders import LoadError, SparseModel, discover, open_model
from sfm_audit.reports.errors import OutputError
from sfm_audit.reports.run_folder.new_files import new_folder
from sfm_audit.reports.text.wording import plain

STORY_FILE: Final = "story.txt"
_SETTINGS: Final = ("noise", "points", "min_effect", "policy")


@click.command("explain", short_help="Tell one image's whole story, as text and pictures.")
@click.argument("model", metavar="MODEL")
@click.argument("image", metavar="IMAGE")
@click.option("-o", "--out", metavar="FOLDER", type=click.Path(path_type=Path), required=True)
@click.option("--noise", type=click.Choice(get_args(NoiseName)), help="Noise model, as in run.")
@click.option("--points", type=click.Choice(get_args(PointsName)), help="As in run.")
@click.option("--min-effect", metavar="TAU", help="Misfit that matters, as in run.")
@click.option("--policy", type=click.Choice(tuple(POLICIES)), help="Which verdicts decide, as in run.")
@click.option(
    "--config", "config_file", metavar="FILE.toml", type=click.Path(path_type=Path), help="Settings, as in run."
)
@click.option("--force", is_flag=True, help="Replace an earlier story in FOLDER.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(*, model: str, image: str, out: Path, config_file: Path | None, **options: Any) -> ExitCode:
    """Say about IMAGE, a name or id:<image_id>, of the COLMAP model MODEL why it is judged as it is.

    The model is audited with the settings given, the defaults of run otherwise. FOLDER then holds story.txt, which is
    also printed, and one picture per figure.

    Exit codes: 0 fine; 2 wrong usage or settings, no such image, or FOLDER is taken; 3 the model cannot be read; 4
    FOLDER could not be written.
    """
    _refuse_taken(out, force=options["force"])
    config = read_config(config_file, {name: options[name] for name in _SETTINGS})
    with extra("report"):
        from sfm_audit.audit.cli.image_story import tell  # noqa: PLC0415 - needs the extra
        from sfm_audit.audit.cli.recompute import auditor_of  # noqa: PLC0415
    try:
        opened = open_model(_location(model))
        image_idx = _image_idx(opened, image)
        told = tell(auditor_of(opened, config), image_idx)
    except LoadError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    try:
        with new_folder(out) as folder:
            (folder / STORY_FILE).write_text(told.text, encoding="utf-8")
            for name, content in told.pictures.items():
                (folder / name).write_bytes(content)
    except (OutputError, OSError) as error:
        problem = error if isinstance(error, OutputError) else OutputError(out, error.strerror or str(error))
        raise KnownError(str(problem), ExitCode.OUTPUT) from error
    if not options["quiet"]:
        print_page(told.text)
    return ExitCode.OK


def _location(model: str) -> str:
    """Return the one model at or below a path."""
    found = discover([model])
    if not found.refs:
        raise found.errors[0]
    if len(found.refs) > 1:
        names = ", ".join(plain(ref.model_path) for ref in found.refs[:3])
        raise KnownError(f"{model}: holds {len(found.refs)} models ({names} ...); name one", ExitCode.USAGE)
    return found.refs[0].location


def _image_idx(model: SparseModel, image: str) -> int:
    same = [i for i, name in enumerate(model.images.name) if name == image]
    if len(same) > 1:
        ids = ", ".join(f"id:{model.images.image_id[i]}" for i in same[:3])
        problem = f"{model.location}: has {len(same)} images called {plain(image)!r}; name one by its id ({ids} ...)"
        raise KnownError(problem, ExitCode.USAGE)
    try:
        return model.image_idx(image)
    except KeyError as error:
        names = ", ".join(plain(name) for name in model.images.name[:3])
        problem = f"{model.location}: has no image {plain(image)!r}; it has {names} ... (or id:<image_id>)"
        raise KnownError(problem, ExitCode.USAGE) from error


def _refuse_taken(out: Path, *, force: bool) -> None:
    """Let nobody lose a folder that is not an earlier story, nor that without asking."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not out.is_dir() or not (out / STORY_FILE).is_file():
        raise KnownError(f"{out}: is not an earlier story; choose a new folder with -o", ExitCode.USAGE)
    foreign = [path.name for path in out.iterdir() if path.name != STORY_FILE and path.suffix != ".png"]
    if foreign:
        raise KnownError(f"{out}: holds {foreign[0]!r} too; choose a new folder with -o", ExitCode.USAGE)
    if not force:
        raise KnownError(f"{out}: holds a story; choose another -o, or replace it with --force", ExitCode.USAGE)
