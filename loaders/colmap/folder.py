"""COLMAP model folders: which files are read, and the one function that reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from sfm_audit.loaders.assembly.assemble import assemble
from sfm_audit.loaders.assembly.raw import FileFormat
from sfm_audit.loaders.colmap import binary, text
from sfm_audit.loaders.colmap.other_format import compare_with_text, mention_ignored_binary
from sfm_audit.loaders.errors import MissingFileError, UnreadableFileError
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.files import exists, is_folder
from sfm_audit.loaders.paths.locations import InputPath, parse_location

REQUIRED: Final = ("cameras", "images", "points3D")
OPTIONAL: Final = ("rigs", "frames")
SUFFIX: Final[dict[FileFormat, str]] = {"binary": ".bin", "text": ".txt"}


def open_model(path: str | Path) -> SparseModel:
    """Read the COLMAP model in the folder ``path``.

    Binary files are taken where all three of them exist, else text files; where both exist and disagree in their
    counts, the model's findings say so. With rigs and frames the poses are composed from them.

    Parameters
    ----------
    path : folder with cameras, images and points3D (.bin or .txt); of this machine, or s3://..., gs://...

    Returns
    -------
    SparseModel
        Whatever can be read, with everything inconsistent in it listed in ``findings``; ``location`` is ``path``.

    Raises
    ------
    LoadError
        Where a file is missing or cannot be read as what it should be.
    """
    folder = parse_location(path)
    file_format = file_format_of(folder)
    if file_format == "binary":
        raw = binary.read_model(folder)
        findings = compare_with_text(folder, raw)
    else:
        raw = text.read_model(folder)
        findings = mention_ignored_binary(folder)
    return assemble(raw, str(path), file_format, findings)


def file_format_of(folder: InputPath) -> FileFormat:
    """Return which files of ``folder`` make up its model.

    Raises
    ------
    MissingFileError
        Where neither the binary nor the text files are complete.
    UnreadableFileError
        Where ``folder`` is a file.
    """
    there = {
        file_format: [f"{name}{suffix}" for name in REQUIRED if exists(folder / f"{name}{suffix}")]
        for file_format, suffix in SUFFIX.items()
    }
    if len(there["binary"]) == len(REQUIRED):
        return "binary"
    if len(there["text"]) == len(REQUIRED):
        return "text"
    if not exists(folder):
        raise MissingFileError(str(folder), None, "a model folder", "nothing", "check the path")
    if not is_folder(folder):
        raise UnreadableFileError(str(folder), None, "a model folder", "a file", "name the folder that holds the model")
    found = there["binary"] + there["text"]
    suffix = SUFFIX["text"] if len(there["text"]) > len(there["binary"]) else SUFFIX["binary"]
    missing = [f"{name}{suffix}" for name in REQUIRED if f"{name}{suffix}" not in found]
    wanted = "cameras, images and points3D, all .bin or all .txt"
    got = f"only {', '.join(found)}" if found else "none of them"
    raise MissingFileError(str(folder), None, wanted, got, f"add {', '.join(missing)}")


def files_of(folder: InputPath) -> tuple[InputPath, ...]:
    """Return the files that `open_model` reads the model from, in a fixed order; errors as of `file_format_of`."""
    suffix = SUFFIX[file_format_of(folder)]
    paths = [folder / f"{name}{suffix}" for name in (*REQUIRED, *OPTIONAL)]
    return tuple(path for path in paths if exists(path))
