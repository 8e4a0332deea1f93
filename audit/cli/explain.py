"""``sfm-audit explain``: one image's whole story as text and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import click

from sfm_audit.audit.cli.again import AGAIN_OPTIONS, Again, with_again
from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.cli.runs import open_run
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.cli.terminal import print_page
from sfm_audit.audit.config import NoiseName, PointsName
from sfm_audit.audit.table import TABLES
from sfm_audit.loaders import LoadError, SparseModel, discover, open_model
from sfm_audit.reports.errors import OutputError, RunFolderError
from sfm_audit.reports.run_folder.disk import RUN_JSON
from sfm_audit.reports.run_folder.new_files import new_folder
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.wording import plain

if TYPE_CHECKING:
    from sfm_audit.audit.cli.image_story import ToldImage

STORY_FILE: Final = "story.txt"
PAGE_FILE: Final = "story.html"
_PHOTO_SIDE: Final = 1200  # px, of the photo on the page
_SETTINGS: Final = ("noise", "points", "min_effect", "policy")


@click.command("explain", short_help="Tell one image's whole story, as text and pictures.")
@click.argument("source", metavar="RUN|MODEL")
@click.argument("image", metavar="IMAGE")
@click.option("-o", "--out", metavar="FOLDER", type=click.Path(path_type=Path), required=True)
@click.option("--scene", metavar="SCENE", help="Of a RUN: the image's scene, or scene/component.")
@click.option("--images", "photos", metavar="DIR", type=click.Path(path_type=Path), help="Photos: write a page too.")
@click.option("--noise", type=click.Choice(get_args(NoiseName)), help="Of a MODEL: noise model, as in run.")
@click.option("--points", type=click.Choice(get_args(PointsName)), help="Of a MODEL: as in run.")
@click.option(
    "--config", "config_file", metavar="FILE.toml", type=click.Path(path_type=Path), help="Of a MODEL: as in run."
)
@with_again
@click.option("--force", is_flag=True, help="Replace an earlier story in FOLDER.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(*, source: str, image: str, out: Path, config_file: Path | None, **options: Any) -> ExitCode:
    """Say about IMAGE, a name or id:<image_id>, why it is judged as it is.

    Of a run folder RUN its verdict and settings are told, under other ones where --policy, --min-effect, --reason or
    --severity ask for them; nothing is audited again. A COLMAP model MODEL is audited first, with the settings given.
    FOLDER then holds story.txt, which is also printed, one picture per figure, and with --images a page story.html
    with all of it and the photo.

    Exit codes: 0 fine; 2 wrong usage or settings, no such image, or FOLDER is taken; 3 RUN or the model cannot be read;
    4 FOLDER could not be written.
    """
    _refuse_taken(out, force=options["force"])
    photos: Path | None = options["photos"]
    if photos is not None and not photos.is_dir():
        raise KnownError(f"{photos}: is no folder; name the folder of the photos", ExitCode.USAGE)
    again = Again.of(**{name: options[name] for name in AGAIN_OPTIONS})
    if (Path(source) / RUN_JSON).is_file():
        _refuse_settings(source, config_file, options)
        told = _of_run(Path(source), image, options["scene"], again)
    else:
        told = _of_model(source, image, config_file, options, again)
    page = _page(told, photos) if photos is not None else None
    try:
        with new_folder(out) as folder:
            (folder / STORY_FILE).write_text(told.text, encoding="utf-8")
            if page is not None:
                (folder / PAGE_FILE).write_text(page, encoding="utf-8")
            for name, content in told.pictures.items():
                (folder / name).write_bytes(content)
    except (OutputError, OSError) as error:
        problem = error if isinstance(error, OutputError) else OutputError(out, error.strerror or str(error))
        raise KnownError(str(problem), ExitCode.OUTPUT) from error
    if not options["quiet"]:
        print_page(told.text)
    return ExitCode.OK


def _refuse_settings(run: str, config_file: Path | None, options: Mapping[str, Any]) -> None:
    given = [name for name in ("noise", "points") if options[name] is not None]
    given += ["config"] if config_file is not None else []
    if given:
        problem = f"{run}: --{given[0]} changes what is measured, and a run was measured already; explain its MODEL"
        raise KnownError(problem, ExitCode.USAGE)


def _of_run(folder: Path, image: str, scene: str | None, again: Again) -> ToldImage:
    with extra("report"):
        from sfm_audit.audit.cli.image_story import tell_from_run  # noqa: PLC0415 - needs the extra
    try:
        run = again.read(open_run(folder))
        return tell_from_run(run, _row_of(run, image, scene))
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error


def _row_of(run: RunReader, image: str, scene: str | None) -> Row:
    """Return the one row of RUN/images that is meant."""
    columns = [column.name for column in TABLES["images"]]
    found: list[Row] = []
    for part, rows in run.parts("images", columns):
        of_scene = [row for row in rows if scene in (None, row["scene"], f"{row['scene']}/{row['component']}")]
        named = [row for row in of_scene if row["image_name"] == image]
        named = named or [row for row in of_scene if image == f"id:{row['image_id']}"]
        found += [{**row, "part": part} for row in named]
    where = f" in {plain(scene)}" if scene else ""
    if not found:
        problem = f"{run.folder}: holds no image {plain(image)!r}{where}; name it as RUN/images does, or id:<image_id>"
        raise KnownError(problem, ExitCode.USAGE)
    if len(found) > 1:
        places = ", ".join(f"{row['scene']}/{row['component']} id:{row['image_id']}" for row in found[:3])
        problem = f"{run.folder}: holds {len(found)} images {plain(image)!r}{where} ({plain(places)} ...)"
        raise KnownError(f"{problem}; choose with --scene SCENE/COMPONENT and id:<image_id>", ExitCode.USAGE)
    return found[0]


def _of_model(model: str, image: str, config_file: Path | None, options: Mapping[str, Any], again: Again) -> ToldImage:
    if options["scene"] is not None or again.rejections:
        raise KnownError(f"{model}: --scene, --reason and --severity are about a RUN, not a model", ExitCode.USAGE)
    config = read_config(config_file, {name: options[name] for name in _SETTINGS})
    with extra("report"):
        from sfm_audit.audit.cli.image_story import tell  # noqa: PLC0415 - needs the extra
        from sfm_audit.audit.cli.recompute import auditor_of  # noqa: PLC0415
    try:
        opened = open_model(_location(model))
        image_idx = _image_idx(opened, image)
        return tell(auditor_of(opened, config), image_idx)
    except LoadError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error


def _page(told: ToldImage, photos: Path) -> str:
    with extra("report"):
        from sfm_audit.reports.html.photos import find_photo, photo_urls  # noqa: PLC0415 - needs the extra
        from sfm_audit.reports.html.story import render_story_page  # noqa: PLC0415
    path = find_photo(photos, told.row)
    urls = photo_urls(path, _PHOTO_SIDE) if path else None
    pictures = [(told.captions[name], content) for name, content in told.pictures.items()]
    return render_story_page(told.row, told.text, pictures, told.residuals, urls[0] if urls else None)


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
        hint = plain(did_you_mean(image, model.images.name)).removesuffix("?")
        problem = f"{model.location}: has no image {plain(image)!r}{hint}; it has {names} ... (or id:<image_id>)"
        raise KnownError(problem, ExitCode.USAGE) from error


def _refuse_taken(out: Path, *, force: bool) -> None:
    """Let nobody lose a folder that is not an earlier story, nor that without asking."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not out.is_dir() or not (out / STORY_FILE).is_file():
        raise KnownError(f"{out}: is not an earlier story; choose a new folder with -o", ExitCode.USAGE)
    foreign = [
        path.name for path in out.iterdir() if path.name not in {STORY_FILE, PAGE_FILE} and path.suffix != ".png"
    ]
    if foreign:
        raise KnownError(f"{out}: holds {foreign[0]!r} too; choose a new folder with -o", ExitCode.USAGE)
    if not force:
        raise KnownError(f"{out}: holds a story; choose another -o, or replace it with --force", ExitCode.USAGE)
