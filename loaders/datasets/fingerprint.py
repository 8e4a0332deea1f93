"""Which bytes a model was read from: names, sizes and hashes of its files, for the record of a run."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sfm_audit.loaders.formats import files_of, format_of
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath, RemotePath, parse_location

_LARGE_BYTES: Final = 1 << 28  # below it, hashing takes less than a second


@dataclass(frozen=True, slots=True)
class InputFile:
    """One file that a model was read from: its name as seen from there, its size in bytes, its SHA-256 in hex.

    Of a file in an object store, the SHA-256 of the store's own name for this version of the content (its entity tag),
    so that asking whether it changed does not mean fetching it.
    """

    name: str
    num_bytes: int
    sha256: str


def input_files(path: str | Path) -> tuple[InputFile, ...]:
    """Return the files that `loaders.open_model` reads the model in the folder ``path`` from.

    Raises
    ------
    LoadError
        Where a file is missing or cannot be read.
    """
    return files_in(parse_location(path))


def files_in(folder: InputPath) -> tuple[InputFile, ...]:
    """Return the same for a location that was parsed.

    Where a file is large, the structure of all files is checked first: a file that was grown by terabytes of zeros is
    refused without being read to its end.
    """
    check = format_of(folder).check
    if check is not None and isinstance(folder, Path) and any(map(_is_large, files_of(folder).values())):
        check(folder)
    return tuple(
        _remote(path) if isinstance(path, RemotePath) else _hashed(path, name)
        for name, path in files_of(folder).items()
    )


def _is_large(path: InputPath) -> bool:
    return isinstance(path, Path) and path.exists() and path.stat().st_size > _LARGE_BYTES


def _remote(path: RemotePath) -> InputFile:
    from sfm_audit.loaders.paths.remote import entity_tag  # noqa: PLC0415 - pyarrow costs what a local run need not pay

    num_bytes, tag = entity_tag(path)
    if tag is None:
        return _hashed(path, path.name)
    return InputFile(path.name, num_bytes, hashlib.sha256(tag.encode()).hexdigest())


def _hashed(path: InputPath, name: str) -> InputFile:
    file, _ = open_input(path, may_be_empty=True)  # the reader says whether it may
    with file, reading(path):
        digest = hashlib.file_digest(file, "sha256")
        return InputFile(name, file.tell(), digest.hexdigest())
