"""Which models lie below the paths a user gives, and what they are called: dataset, scene, component."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from sfm_audit.loaders.datasets.input_state import model_files_in, size_of, stamp_of
from sfm_audit.loaders.datasets.layouts import (
    LAYOUTS,
    ONLY_COMPONENT,
    Layout,
    Parts,
    Place,
    distinct,
    folders_to_search,
    place_of,
    without_copies,
)
from sfm_audit.loaders.datasets.walk import LIMITS, Folder, leads_out, walk
from sfm_audit.loaders.errors import LoadError, MissingFileError, UnreadableFileError
from sfm_audit.loaders.formats import files_below, format_names, marks_model, model_files_among, without_points
from sfm_audit.loaders.paths.files import exists, is_folder, listing_of
from sfm_audit.loaders.paths.locations import Entry, InputPath, RemotePath, below, parse_location, real_location

_REQUESTS_AT_ONCE: Final = 16  # to an object store: its answers take their time, and not this machine's
_EXAMPLES: Final = 3
FOLLOW: Final = "give --follow-links if you trust them"


@dataclass(frozen=True, slots=True)
class ModelRef:
    """One model folder and its place in a data set.

    dataset: base name of the path the user gave.    scene, component: by the folder names, see `layouts`.
    location: real absolute path, or URI.    model_path: the path as given, joined with the path below it.
    num_bytes: size of the files that the model is read from.
    stamp: `input_stamp` when the model was found in an object store; empty for local models, which
    are asked again at no cost.
    layout: name of the rule that gave scene and component, see `layouts.LAYOUTS`.
    below: the path from the PATH that the user gave to the folder, with slashes; empty where it is the folder.
    """

    dataset: str
    scene: str
    component: str
    location: str
    model_path: str
    num_bytes: int = field(default=0, compare=False)
    stamp: str = field(default="", compare=False, repr=False)
    layout: str = field(default="", compare=False)
    below: str = field(default="", compare=False)

    @property
    def key(self) -> str:
        """Name of the model's part in a run folder: 16 hex digits that depend on the location alone."""
        return hashlib.sha256(os.fsencode(self.location)).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Discovery:
    """The models found, sorted by dataset, scene, component and location, and the paths in which there are none.

    left_out: models that were found and not asked for, by another layout than the one wanted or `selection`.
    notes: one line per PATH in which links to the outside were not followed; they are no errors.
    """

    refs: tuple[ModelRef, ...]
    errors: tuple[LoadError, ...]
    left_out: tuple[ModelRef, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Found:
    """A model folder: the names that lead from the root to it, its size and its stamp."""

    parts: Parts
    num_bytes: int
    stamp: str = ""


def discover(paths: Sequence[str | Path], layout: str | None = None, *, follow_links: bool = False) -> Discovery:
    """Find all models at and below ``paths``.

    A folder that holds any of COLMAP's model files counts as a model, so that a broken one is reported when it is
    opened instead of vanishing; nothing below it is searched, but hloc's ``models``. Hidden folders are skipped. Links
    inside a path are followed, loops end; links to its outside are not followed. A model that several paths lead to is
    named once, after the first of them. Of D2-Net's two copies of a model the binary one is taken.

    Parameters
    ----------
    paths : model folders, their parents, or data set roots; of this machine, or s3://..., gs://...
    layout : a name in `layouts.LAYOUTS`: models elsewhere are left out; None: every model by the first layout
        that knows its folder's names
    follow_links : whether to follow links to folders outside of a path, and read files through such links; a path that
        is itself a link is always followed

    Returns
    -------
    Discovery
        The models in a fixed order. A path that does not exist, cannot be searched or holds no model becomes an
        entry of ``errors`` and does not hide the others.
    """
    wanted = None if layout is None else LAYOUTS[layout]
    refs: dict[str, ModelRef] = {}
    left_out: dict[str, ModelRef] = {}
    errors: list[LoadError] = []
    notes: list[str] = []
    for path in paths:
        found = _models_below(path, wanted, follow_links=follow_links)
        errors += found.errors
        notes += found.notes
        for ref in found.refs:
            refs.setdefault(ref.location, ref)
        for ref in found.left_out:
            left_out.setdefault(ref.location, ref)
    return Discovery(
        in_order(refs.values()),
        tuple(errors),
        in_order(ref for location, ref in left_out.items() if location not in refs),
        tuple(notes),
    )


def in_order(refs: Iterable[ModelRef]) -> tuple[ModelRef, ...]:
    """Return models in the order that everything is written in."""
    return tuple(sorted(refs, key=lambda ref: (ref.dataset, ref.scene, ref.component, ref.location)))


def _models_below(given: str | Path, layout: Layout | None, *, follow_links: bool) -> Discovery:
    try:
        root = parse_location(given)
    except LoadError as error:
        return Discovery((), (error,))
    try:
        _check_root(root)
        searched = _search(root, layout, follow_links=follow_links)
    except LoadError as error:  # named as the user typed it
        return Discovery((), (type(error)(str(given), error.position, error.wanted, error.got, error.advice),))
    found, errors = searched.found, searched.errors
    named_parts = root.parts if isinstance(root, RemotePath) else _named_parts(root)
    dataset = named_parts[-1] if named_parts else str(root)
    places = {each.parts: place_of(named_parts + each.parts, layout) for each in found}
    known = distinct(without_copies({parts: place for parts, place in places.items() if place}, layout))
    refs, left_out = [], []
    for each in found:
        model_path = below(str(given), each.parts)
        place = known.get(each.parts)
        if place:
            refs.append(_ref(dataset, place, model_path, each))
        elif places[each.parts] is None:
            other = place_of(named_parts + each.parts) or Place("", ONLY_COMPONENT, 0)
            left_out.append(_ref(dataset, other, model_path, each))
    if not refs and not errors:
        errors.append(_nothing_found(str(given), root, left_out, layout))
    return Discovery(tuple(refs), tuple(errors), tuple(left_out), _notes(str(given), searched.links_out))


def _notes(given: str, links_out: Sequence[str]) -> tuple[str, ...]:
    if not links_out:
        return ()
    more = f" and {len(links_out) - 1} more" if len(links_out) > 1 else ""
    return (f"{given}: links to folders outside of it are not followed: {links_out[0]}{more}; {FOLLOW}",)


def _check_root(root: InputPath) -> None:
    """Raise unless ``root`` is a folder; the listing comes first: its errors are more specific (no such bucket)."""
    if (isinstance(root, RemotePath) and listing_of(root)) or is_folder(root):
        return
    real = Path(os.path.realpath(root)) if isinstance(root, Path) else root
    if exists(real):
        got = "a circle of links" if isinstance(real, Path) and real.is_symlink() else "a file"
        raise UnreadableFileError(str(root), None, "a folder", got, "name the folder that holds the model")
    raise MissingFileError(str(root), None, "a folder", "nothing", "check the path")


def _ref(dataset: str, place: Place, model_path: str, found: _Found) -> ModelRef:
    location = real_location(model_path)
    below_it = "/".join(found.parts)
    names = dataset, place.scene, place.component
    return ModelRef(*names, location, model_path, found.num_bytes, found.stamp, place.layout, below_it)


def _nothing_found(given: str, root: InputPath, left_out: Sequence[ModelRef], layout: Layout | None) -> LoadError:
    known = None if left_out else without_points(root)
    if known is not None:
        return MissingFileError(given, None, "a model with points at or below it", *known)
    if layout is None or not left_out:
        wanted, got = "a model folder at or below it", f"no file of a model ({', '.join(format_names())})"
        return MissingFileError(given, None, wanted, got, "name a folder that holds models")
    examples = ", ".join(ref.model_path for ref in left_out[:_EXAMPLES])
    return MissingFileError(
        given,
        None,
        f"models laid out as {layout.name} has them ({layout.pattern})",
        f"{len(left_out)} elsewhere: {examples}{', ...' if len(left_out) > _EXAMPLES else ''}",
        "leave out --layout, or name another one",
    )


def _named_parts(root: Path) -> Parts:
    """Return the names that lead to ``root`` from the file system's root: as typed, "." and ".." resolved."""
    return Path(os.path.abspath(root)).parts[1:]  # noqa: PTH100 - resolve() would replace a link by what it names


def scene_and_component(parts: Parts) -> tuple[str, str]:
    """Return what the model in the folder with these path parts is called."""
    place = place_of(parts)
    return (place.scene, place.component) if place else ("", ONLY_COMPONENT)


@dataclass(frozen=True, slots=True)
class _Search:
    """The model folders below a root, what cannot be searched, and links to the outside that were not followed."""

    found: list[_Found]
    errors: list[LoadError]
    links_out: list[str] = field(default_factory=list)


def _search(root: InputPath, layout: Layout | None, *, follow_links: bool) -> _Search:
    """Return the model folders at and below ``root``, and what was not searched."""
    if isinstance(root, RemotePath):
        return _search_remote(root, layout)
    return _search_local(root, layout, follow_links=follow_links)


def _search_local(root: Path, layout: Layout | None, *, follow_links: bool) -> _Search:
    found: list[_Found] = []
    root_parts = _named_parts(root)
    errors: list[LoadError] = []

    def visit(folder: Folder) -> Sequence[str]:
        is_model = marks_model([*folder.files, *folder.folders])
        if is_model:
            out = [] if follow_links else _files_out(folder, root)
            if out:
                errors.append(_leads_out(folder.path, out))
            else:
                found.append(_Found(folder.parts, size_of(model_files_in(folder.path))))
        folders = list(folder.folders)
        return folders_to_search(root_parts + folder.parts, folders, is_model=is_model, layout=layout)

    met = walk(root, visit, follow_links=follow_links)
    return _Search(found, errors + met.errors, met.links_out)


def _files_out(folder: Folder, root: Path) -> list[str]:
    """Names of a model's files that are links to the outside of the PATH."""
    there = {*folder.files, *folder.folders}
    names = model_files_among(there)
    return [name for name in (*names, *files_below(folder.path, names)) if leads_out(folder.path / name, root)]


def _leads_out(folder: Path, names: list[str]) -> LoadError:
    got = f"links to the outside: {', '.join(names)}"
    return UnreadableFileError(str(folder), None, "files that lie inside the PATH", got, FOLLOW)


def _search_remote(root: RemotePath, layout: Layout | None) -> _Search:
    """Ask level by level, many folders at once; no deeper and no more than a walk on this machine."""
    found: list[_Found] = []
    errors: list[LoadError] = []
    level: list[tuple[Parts, RemotePath]] = [((), root)]
    with ThreadPoolExecutor(_REQUESTS_AT_ONCE) as pool:
        depth = num_folders = 0
        while level:
            num_folders += len(level)
            if depth > LIMITS.max_depth or num_folders > LIMITS.max_folders:
                got = f"{len(level)} folders more than {depth} deep, or more than {LIMITS.max_folders} in all"
                advice = "name the folders with the models"
                errors.append(LoadError(str(root), None, "a data set that can be searched", got, advice))
                break
            depth += 1
            asked = list(pool.map(lambda each: _listing_or_error(each[1]), level))
            below_it: list[tuple[Parts, RemotePath]] = []
            for (parts, folder), listing in zip(level, asked, strict=True):
                if isinstance(listing, LoadError):
                    errors.append(listing)
                    continue
                is_model = marks_model(listing)
                if is_model:
                    files = {name: listing[name] for name in model_files_among(listing)}
                    found.append(_Found(parts, size_of(files), stamp_of(files)))
                folders = [name for name, entry in listing.items() if entry.is_folder]
                folders = folders_to_search(folder.parts, folders, is_model=is_model, layout=layout)
                below_it += [((*parts, name), replace(folder, parts=(*folder.parts, name))) for name in folders]
            level = below_it
    return _Search(sorted(found, key=lambda each: each.parts), errors)


def _listing_or_error(folder: RemotePath) -> Mapping[str, Entry] | LoadError:
    try:
        return listing_of(folder)
    except LoadError as error:
        return error
