"""Which models does a command mean? Those at and below its PATHs, of a layout, of chosen scenes and components."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.loaders import Discovery, LoadError, discover
from sfm_audit.loaders.datasets.image_counts import count_images_of
from sfm_audit.loaders.datasets.layouts import LAYOUTS
from sfm_audit.loaders.datasets.selection import Selection, read_scene_list, select
from sfm_audit.loaders.paths.locations import parse_location
from sfm_audit.reports.run_folder.disk import RUN_JSON
from sfm_audit.reports.text.wording import plain

UNKNOWN: Final = "-"
CHOICE_OF_MODELS: Final = ("layout", "scenes", "components", "scene_lists", "follow_links")
"""Names of the options that choose models."""
_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a user asks for of what lies below the PATHs: models of one layout (None: of any), some of their scenes.

    follow_links: whether links that lead out of a PATH are followed.
    """

    layout: str | None = None
    selection: Selection = field(default_factory=Selection)
    follow_links: bool = False


def with_choice_of_models(command: _Command) -> _Command:
    """Add the options that choose models to a command; `wanted_of` takes what they say."""
    layouts = click.Choice(["auto", *LAYOUTS])
    options = (
        click.option("--layout", type=layouts, default="auto", help="Only models that lie as this data set's do."),
        click.option(
            "--scene", "scenes", metavar="GLOB", multiple=True, help="Only scenes of such a name. Repeatable."
        ),
        click.option("--component", "components", metavar="GLOB", multiple=True, help="Only such components."),
        click.option(
            "--scene-list",
            "scene_lists",
            metavar="FILE",
            multiple=True,
            type=click.Path(path_type=Path),
            help="Only the scenes named in FILE, one per line: scene, or scene/component.",
        ),
        click.option("--follow-links", is_flag=True, help="Follow links that lead out of a PATH."),
    )
    for option in reversed(options):
        command = option(command)
    return command


def wanted_of(
    *,
    layout: str,
    scenes: Iterable[str],
    components: Iterable[str],
    scene_lists: Iterable[Path],
    follow_links: bool = False,
) -> Wanted:
    """Return what the options say.

    Raises
    ------
    KnownError
        A list of scenes cannot be read.
    """
    try:
        lists = tuple(read_scene_list(path) for path in scene_lists)
    except LoadError as error:
        raise KnownError(str(error), ExitCode.USAGE) from error
    selection = Selection(tuple(scenes), tuple(components), lists)
    return Wanted(None if layout == "auto" else layout, selection, follow_links)


def find_models(paths: Sequence[str], wanted: Wanted) -> Discovery:
    """Return the models below the PATHs that are asked for; the others are left out.

    Raises
    ------
    KnownError
        A PATH is a URI that means nothing here, or holds a secret; or it is a run folder.
    """
    for path in paths:
        try:
            parse_location(path)
        except LoadError as error:
            raise KnownError(str(error), ExitCode.USAGE) from error
    found = select(discover(paths, wanted.layout, follow_links=wanted.follow_links), wanted.selection)
    for path in paths:
        if not found.refs and (Path(path) / RUN_JSON).is_file():
            said = "is the folder of a run and holds no models; report, diagnose, filter and check read it"
            raise KnownError(f"{path}: {said}", ExitCode.UNREADABLE_INPUT)
    for note in found.notes:
        click.echo(f"sfm-audit: {plain(note)}", err=True)
    return found


def refuse_lost(option: str, named: str | None, *, folder: str | None = None) -> None:
    """Refuse what an option names on this machine and is not there, once and not for every model.

    folder: what to do about a folder; None where it may be one.

    Raises
    ------
    KnownError
        There is no such file; one in an object store is asked when it is read.
    """
    if named in {None, "auto"}:
        return
    try:
        path = parse_location(str(named))
    except LoadError as error:
        raise KnownError(f"{option}: {error}", ExitCode.USAGE) from error
    if isinstance(path, Path) and not path.exists():
        raise KnownError(f"{option} {named}: there is no such file; check the path", ExitCode.UNREADABLE_INPUT)
    if folder is not None and isinstance(path, Path) and path.is_dir():
        raise KnownError(f"{option} {named}: is a folder; {folder}", ExitCode.UNREADABLE_INPUT)


def listed(found: Discovery) -> tuple[list[str], list[str]]:
    """Return one line per model, and one per problem.

    A line holds dataset, scene, component, number of images (- where the files do not say), bytes, location and the
    name of the layout, separated by tabs.
    """
    counts = count_images_of([ref.location for ref in found.refs])
    lines = []
    for ref, count in zip(found.refs, counts, strict=True):
        images = UNKNOWN if isinstance(count, LoadError) else str(count)
        cells = (ref.dataset, ref.scene, ref.component, images, str(ref.num_bytes), ref.model_path, ref.layout)
        lines.append("\t".join(plain(cell) for cell in cells))
    problems = [*found.errors, *(count for count in counts if isinstance(count, LoadError))]
    return lines, [plain(str(problem)) for problem in problems]
