"""Did the files of a model change since they were audited? Sizes and times first, content when those differ."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from loaders.colmap import OPTIONAL, REQUIRED, SUFFIX
from loaders.fingerprint import input_files


@dataclass(frozen=True, slots=True)
class InputState:
    """The files of one model at one moment.

    num_bytes : size of the files that the model is read from
    stamp : names, sizes and times of change of all files in the folder that can matter; equal: nothing was touched
    digest : SHA-256 over the content of the files that the model is read from (and the stamps of the others)
    """

    num_bytes: int
    stamp: str
    digest: str


def input_stamp(location: str) -> str:
    """Return the cheap part of the state; empty where there are no model files."""
    return " ".join(_stamps(Path(location)).values())


def read_input_state(location: str) -> InputState:
    """Read all files of the model in the folder ``location`` and return their state.

    Raises
    ------
    LoadError
        Where a file is missing or cannot be read.
    """
    stamps = _stamps(Path(location))  # before the content: a file that changes in between counts as changed next time
    files = input_files(location)
    read = {file.name for file in files}
    parts = [f"{file.name}:{file.sha256}" for file in files] + [stamps[name] for name in stamps if name not in read]
    digest = hashlib.sha256(" ".join(parts).encode()).hexdigest()
    return InputState(sum(file.num_bytes for file in files), " ".join(stamps.values()), digest)


def input_size(location: str) -> int:
    """Return the size in bytes of all model files in the folder, 0 where there are none."""
    return sum(int(stamp.split(":")[1]) for stamp in _stamps(Path(location)).values())


def _stamps(folder: Path) -> dict[str, str]:
    stamps = {}
    for name in (f"{stem}{suffix}" for stem in (*REQUIRED, *OPTIONAL) for suffix in SUFFIX.values()):
        try:
            stat = (folder / name).stat()
        except OSError:
            continue  # not there, or not to be read: opening the model says which
        stamps[name] = f"{name}:{stat.st_size}:{stat.st_mtime_ns}"
    return stamps
