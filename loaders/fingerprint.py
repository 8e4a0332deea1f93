"""Which bytes a model was read from: names, sizes and hashes of its files, for the record of a run."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from loaders.colmap import files_of
from loaders.files import open_input


@dataclass(frozen=True, slots=True)
class InputFile:
    """One file that a model was read from: its name in the model folder, its size in bytes, its SHA-256 in hex."""

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
    result = []
    for file_path in files_of(Path(path)):
        file, _ = open_input(file_path)
        with file:
            digest = hashlib.file_digest(file, "sha256")
            result.append(InputFile(file_path.name, file.tell(), digest.hexdigest()))
    return tuple(result)
