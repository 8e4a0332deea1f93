"""Opens input files; every reason why a file cannot be read becomes a LoadError here, before a format is parsed."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Final

from sfm_audit.loaders.errors import (
    LfsPointerError,
    LoadError,
    MissingFileError,
    TruncatedFileError,
    UnreadableFileError,
)
from sfm_audit.loaders.paths.locations import Entry, InputPath, RemotePath

LFS_PREFIX: Final = b"version https://git-lfs.github.com/spec/"
_COPY_AGAIN: Final = "copy or export the reconstruction again"


def exists(path: InputPath) -> bool:
    """Whether ``path`` exists, readable or not; LoadError where an object store does not answer."""
    if isinstance(path, Path):
        return os.path.lexists(path)
    if path.folder is not None:
        return path.name in listing_of(path.folder)
    from sfm_audit.loaders.paths.remote import kind_of  # noqa: PLC0415 - pyarrow costs what a local run need not pay

    return kind_of(path) is not None


def listing_of(folder: RemotePath) -> Mapping[str, Entry]:
    """Return what lies in a folder of an object store, by name, as of the first call for this `RemotePath`.

    Raises
    ------
    LoadError
        The store refuses or does not answer.
    """
    from sfm_audit.loaders.paths.remote import list_folder  # noqa: PLC0415 - as above

    if not folder.listings:
        folder.listings.append(list_folder(folder))
    return folder.listings[0]


def is_folder(path: InputPath) -> bool:
    """Whether ``path`` is a folder; LoadError where an object store does not answer."""
    if isinstance(path, Path):
        return path.is_dir()
    from sfm_audit.loaders.paths.remote import kind_of  # noqa: PLC0415 - as above

    return kind_of(path) == "folder"


def open_input(path: InputPath, *, only_head: bool = False) -> tuple[BufferedReader, int]:
    """Open a regular, non-empty file that is no Git LFS pointer.

    A file of an object store is read in large pieces while the caller reads, in small ones for a caller that wants
    ``only_head``; nothing is stored on this machine.

    Returns
    -------
    tuple
        The file, positioned at its start, and its size in bytes.

    Raises
    ------
    MissingFileError, UnreadableFileError, LfsPointerError
        Where the file does not exist, cannot be read, or holds a pointer instead of data.
    TruncatedFileError
        Where the file holds no byte at all.
    """
    file, size = _open_remote(path, only_head=only_head) if isinstance(path, RemotePath) else _open_local(path)
    try:
        with reading(path):
            _check_content(path, file, size)
    except LoadError:
        file.close()
        raise
    return file, size


def _open_remote(path: RemotePath, *, only_head: bool) -> tuple[BufferedReader, int]:
    from sfm_audit.loaders.paths.remote import HEAD_BYTES, PIECE_BYTES, open_remote  # noqa: PLC0415 - as above

    return open_remote(path, HEAD_BYTES if only_head else PIECE_BYTES)


def _open_local(path: Path) -> tuple[BufferedReader, int]:
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):  # asked before opening: opening a pipe would wait for its writer
            file = path.open("rb")
    except FileNotFoundError:
        raise MissingFileError(str(path), None, "a file", "nothing", _COPY_AGAIN) from None
    except OSError as error:
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(mode):
        got = "a folder" if stat.S_ISDIR(mode) else "neither a file nor a folder"
        raise UnreadableFileError(str(path), None, "a file", got, "put the reconstruction's file in its place")
    return file, os.fstat(file.fileno()).st_size


def _check_content(path: InputPath, file: BufferedReader, size: int) -> None:
    """Raise LoadError where the file holds no byte, or a Git LFS pointer."""
    head = file.peek(len(LFS_PREFIX))[: len(LFS_PREFIX)]  # reading and going back would ask a store twice
    if head == LFS_PREFIX:
        advice = "fetch the data with `git lfs pull`"
        raise LfsPointerError(str(path), None, "a reconstruction's data", "a Git LFS pointer", advice)
    if size == 0:
        raise TruncatedFileError(str(path), None, "a reconstruction's data", "an empty file", _COPY_AGAIN)


def read_bytes(path: InputPath) -> bytes:
    """Return the content of ``path``; errors as of `open_input`."""
    file, _ = open_input(path)
    with file, reading(path):
        return file.read()


@contextmanager
def reading(path: InputPath) -> Iterator[None]:
    """Turn errors while reading an open file, such as a failing disk, into a LoadError."""
    try:
        yield
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: InputPath, error: OSError) -> UnreadableFileError:
    got = error.strerror or type(error).__name__
    return UnreadableFileError(str(path), None, "a readable file", got, "check its permissions and its disk")
