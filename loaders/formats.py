"""Which formats of model files can be read? The one list of them, and the questions that the list answers."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final, TypeVar

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.colmap.formats import BINARY, TEXT
from sfm_audit.loaders.colmap.pairs import database_pairs
from sfm_audit.loaders.errors import LoadError, MissingFileError, UnreadableFileError
from sfm_audit.loaders.foreign.bal import BAL
from sfm_audit.loaders.foreign.blocks_exchange import BLOCKS_EXCHANGE
from sfm_audit.loaders.foreign.bundler import BUNDLER
from sfm_audit.loaders.foreign.kapture import KAPTURE
from sfm_audit.loaders.foreign.nvm import NVM
from sfm_audit.loaders.foreign.openmvg import OPENMVG
from sfm_audit.loaders.foreign.openmvg_binary import OPENMVG_BINARY
from sfm_audit.loaders.foreign.opensfm import OPENSFM
from sfm_audit.loaders.model import PairSource, SparseModel
from sfm_audit.loaders.model_format import ModelFormat, ModelWriter, matching
from sfm_audit.loaders.paths.files import exists, is_folder, names_in
from sfm_audit.loaders.paths.locations import InputPath

FORMATS: tuple[ModelFormat, ...] = (
    BINARY,
    TEXT,
    OPENSFM,
    OPENMVG_BINARY,
    OPENMVG,
    BUNDLER,
    NVM,
    BAL,
    BLOCKS_EXCHANGE,
    KAPTURE,
)
"""Asked in this order: the first format whose required files all lie in a folder is the one that is read there."""

WITHOUT_POINTS: Final[Mapping[str, str]] = {
    "transforms.json": "transforms.json (nerfstudio, instant-ngp) holds cameras and no points",
    "cameras.xml": "cameras.xml, Metashape's own export of cameras, holds no tie points",
}
"""Files that people take for models and that hold no observations: what is said of a folder that has no other."""
_ASKED_FOR: Final = {
    "transforms.json": "audit the COLMAP model that it was made from",
    "cameras.xml": "export BlocksExchange XML with tie points from Metashape",
}
_BESIDE: Final = ("colmap/sparse/0", "sparse/0", "colmap/sparse", "sparse", "colmap")

_Value = TypeVar("_Value")


def format_names() -> tuple[str, ...]:
    """Return the values that the column ``file_format`` may have."""
    return tuple(each.name for each in FORMATS)


def written_file_names() -> tuple[str, ...]:
    """Return the names of all files that a model can be written to, in a fixed order."""
    return tuple(dict.fromkeys(name for each in FORMATS if each.writer for name in each.files))


def model_files_among(names: Collection[str]) -> tuple[str, ...]:
    """Return those of a folder's names that can belong to a model, in a fixed order."""
    return tuple(dict.fromkeys(name for each in FORMATS for name in each.among(names)))


def model_file_names(folder: InputPath) -> tuple[str, ...]:
    """Return the names of all files in ``folder`` that can belong to its model, in a fixed order.

    Of a folder of this machine that cannot be listed, those whose names are known beforehand and that exist.
    """
    known = tuple(dict.fromkeys(name for each in FORMATS for name in each.files))
    there = {name for name in known if "*" not in name and exists(folder / name)} if isinstance(folder, Path) else set()
    names = model_files_among(there | set(names_in(folder)))
    return (*names, *files_below(folder, names))


def files_below(folder: InputPath, names: Collection[str]) -> tuple[str, ...]:
    """Return the names of files in sub-folders that the model in a folder of this machine with ``names`` may need."""
    found = next((each for each in FORMATS if each.matches(names)), None)
    return found.below(folder) if found is not None and isinstance(folder, Path) else ()


def marks_model(names: Collection[str]) -> bool:
    """Whether a folder with these names counts as a model folder: it has a file that some format requires."""
    return any(matching(name, names) for each in FORMATS for name in each.required)


def without_points(folder: InputPath) -> tuple[str, str] | None:
    """Return what is said of a folder that has no model but a file of `WITHOUT_POINTS`, and what to do; else None.

    Where the COLMAP model that nerfstudio's or instant-ngp's file was made from lies below the folder, it is named.
    """
    found = next((name for name in WITHOUT_POINTS if name in names_in(folder)), None)
    if found is None:
        return None
    advice = _ASKED_FOR[found]
    if found == "transforms.json":
        places = (folder.joinpath(*place.split("/")) for place in _BESIDE) if isinstance(folder, Path) else ()
        model = next((place for place in places if marks_model(names_in(place))), None)
        advice += f", {model}" if model is not None else ""
    return WITHOUT_POINTS[found], advice


def files_read(listing: Mapping[str, _Value]) -> dict[str, _Value]:
    """Return the part of a folder's listing that its model is read from; of an incomplete model all of its files."""
    found = next((each for each in FORMATS if each.matches(listing)), None)
    names = found.among(listing) if found else model_files_among(listing)
    return {name: listing[name] for name in names}


def format_of(folder: InputPath) -> ModelFormat:
    """Return the format of the model in ``folder``.

    Raises
    ------
    MissingFileError
        No format's files are complete.
    UnreadableFileError
        ``folder`` is a file.
    """
    there = model_file_names(folder)
    found = next((each for each in FORMATS if each.matches(there)), None)
    if found is not None:
        return found
    if not exists(folder):
        raise MissingFileError(str(folder), None, "a model folder", "nothing", "check the path")
    if not is_folder(folder):
        raise UnreadableFileError(str(folder), None, "a model folder", "a file", "name the folder that holds the model")
    raise _incomplete(folder, there)


def files_of(folder: InputPath) -> dict[str, InputPath]:
    """Return the files that the model in ``folder`` is read from, by name, in a fixed order; errors as of `format_of`.

    A name is seen from the folder, as ``../sensors/sensors.txt``.
    """
    return {name: folder / name for name in format_of(folder).among(model_file_names(folder))}


def format_named(name: str) -> ModelFormat:
    """Return the format with the name that a model's ``file_format`` holds; KeyError where there is none."""
    found = next((each for each in FORMATS if each.name == name), None)
    if found is None:
        raise KeyError(name)
    return found


def writer_of(model: SparseModel) -> ModelWriter:
    """Return what writes a model in its own format; LoadError where that format is only read."""
    writer = format_named(model.file_format).writer
    if writer is None:
        writable = ", ".join(each.name for each in FORMATS if each.writer)
        got, advice = f"one in the format {model.file_format}", "convert the model first, or use --list"
        raise LoadError(model.location, None, f"a model in a format that can be written ({writable})", got, advice)
    return writer


def keypoint_scales_of(model: SparseModel, shown_as: str) -> FloatArray:
    """Return (M,) keypoint sizes, px, of a model's observations.

    Parameters
    ----------
    model : as `open_model` read it
    shown_as : the model's location for messages

    Raises
    ------
    LoadError
        The format has none, or they cannot be read.
    """
    scales = format_named(model.file_format).keypoint_scales
    if scales is None:
        wanted, got = "a format that keeps the sizes of keypoints", f"the format {model.file_format}"
        raise LoadError(shown_as, None, wanted, got, "use --noise track")
    return scales(model, shown_as)


def verified_pairs_of(model: SparseModel, database: str | None, shown_as: str, below: str = "") -> PairSource | None:
    """Return the verified pairs of a model; None where no database was named.

    Parameters
    ----------
    database : its location, or ``auto``: the one that belongs to the model, where there is one
    shown_as : the model's location for messages            below : its path below what the user gave, with slashes

    Raises
    ------
    LoadError
        The named database cannot be read, or does not fit the model.
    """
    return None if database is None else database_pairs(model, database, shown_as, below)


def _incomplete(folder: InputPath, there: tuple[str, ...]) -> MissingFileError:
    """Return the error for a folder in which no format is complete; the format that lacks least is meant."""
    meant = max(
        FORMATS, key=lambda each: sum(bool(matching(name, there)) for name in each.required)
    )  # the first of equals
    missing = [name for name in meant.required if not matching(name, there)]
    wanted = (
        f"{', '.join(meant.required[:-1])} and {meant.required[-1]}" if len(meant.required) > 1 else meant.required[0]
    )
    known = None if there else without_points(folder)
    if known is not None:
        return MissingFileError(str(folder), None, "a model with points", *known)
    got = f"only {', '.join(there)}" if there else "none of them"
    other_case = {name.lower(): name for name in names_in(folder) if name not in there}
    renamed = [f"rename {other_case[name.lower()]} to {name}" for name in missing if name.lower() in other_case]
    missing = [name for name in missing if name.lower() not in other_case]
    advice = "; ".join([*renamed, *([f"add {', '.join(missing)}"] if missing else [])])
    return MissingFileError(str(folder), None, wanted, got, advice)
