"""Did the files of a model change since they were audited? Sizes and times first, content when those differ."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from stat import S_ISDIR
from typing import Final

from sfm_audit.loaders.datasets.fingerprint import files_in
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.formats import files_read, model_file_names, model_files_among
from sfm_audit.loaders.paths.files import listing_of
from sfm_audit.loaders.paths.locations import Entry, InputPath, RemotePath, parse_location

_MANY: Final = 64
"""More files than this are those of a format that keeps one per image."""


@dataclass(frozen=True, slots=True)
class InputState:
    """The files of one model at one moment.

    num_bytes : size of the files that the model is read from
    stamp : names, sizes and times of change of all files in the folder that can matter; equal: nothing was touched
    digest : SHA-256 over the content of the files that the model is read from (and the stamps of the others)
    evidence : the state of what was given besides the model (`loaders.references.state`); empty without
    """

    num_bytes: int
    stamp: str
    digest: str
    evidence: str = ""


def input_stamp(location: str) -> str:
    """Return the cheap part of the state; empty where there are no model files."""
    return stamp_of(model_files_in(parse_location(location)))


def read_input_state(location: str) -> InputState:
    """Read all files of the model in the folder ``location`` and return their state.

    Raises
    ------
    LoadError
        Where a file is missing or cannot be read.
    """
    folder = parse_location(location)
    found = model_files_in(folder)  # before the content: a file that changes in between counts as changed next time
    files = files_in(folder)
    read = {file.name for file in files}
    parts = [f"{file.name}:{file.sha256}" for file in files]
    parts += [stamp_of({name: there}) for name, there in found.items() if name not in read]
    digest = hashlib.sha256(" ".join(parts).encode()).hexdigest()
    return InputState(sum(file.num_bytes for file in files), stamp_of(found), digest)


def is_unchanged(location: str, known: InputState, *, verify: bool) -> bool:
    """Whether the files of a model are those of a known state.

    Parameters
    ----------
    verify : compare the content, which costs reading all of it; otherwise equal names, sizes and times of change are
        taken for equal content, which copying with ``cp -p``, ``rsync -t`` or ``touch -r`` can make untrue

    Raises
    ------
    LoadError
        Where ``verify`` and a file is missing or cannot be read.
    """
    if input_stamp(location) != known.stamp:
        return read_input_state(location).digest == known.digest
    return not verify or read_input_state(location).digest == known.digest


def input_size(location: str) -> int:
    """Return the size in bytes of the files that the model is read from, 0 where there are none."""
    return size_of(model_files_in(parse_location(location)))


def stamp_of(files: Mapping[str, Entry]) -> str:
    """Return names, sizes and times of change of model files as one string, of many files a hash of it."""
    stamp = " ".join(f"{name}:{there.num_bytes}:{there.mtime_ns}" for name, there in files.items())
    return stamp if len(files) <= _MANY else hashlib.sha256(stamp.encode(errors="surrogateescape")).hexdigest()


def size_of(files: Mapping[str, Entry]) -> int:
    """Return the size in bytes of the files that `loaders.open_model` would read of these."""
    return sum(there.num_bytes for there in files_read(files).values())


def model_files_in(folder: InputPath) -> dict[str, Entry]:
    """Return the files of ``folder`` that can matter to its model, in a fixed order; none where it cannot be read."""
    if isinstance(folder, RemotePath):
        try:
            listing = listing_of(folder)
        except LoadError:
            return {}  # opening the model says what is wrong
        return {name: listing[name] for name in model_files_among(listing)}
    files = {}
    for name in model_file_names(folder):
        try:
            stat = (folder / name).stat()
        except OSError:
            continue  # not there, or not to be read: opening the model says which
        files[name] = Entry(is_folder=S_ISDIR(stat.st_mode), num_bytes=stat.st_size, mtime_ns=stat.st_mtime_ns)
    return files
