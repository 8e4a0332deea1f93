"""Opening input files: whatever keeps a file from being read becomes a LoadError here, before any format is parsed."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Final

from loaders.errors import LfsPointerError, LoadError, MissingFileError, TruncatedFileError, UnreadableFileError

LFS_PREFIX: Final = b"version https://git-lfs.github.com/spec/"
_COPY_AGAIN: Final = "copy or export the reconstruction again"


def exists(path: Path) -> bool:
    """Whether something lies at ``path``, readable or not."""
    return os.path.lexists(path)


def open_input(path: Path) -> tuple[BufferedReader, int]:
    """Open a regular, non-empty file that is no Git LFS pointer.

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
    try:
        size = _check_content(path, file)
    except OSError as error:
        file.close()
        raise _unreadable(path, error) from error
    except LoadError:
        file.close()
        raise
    return file, size


def _check_content(path: Path, file: BufferedReader) -> int:
    """Return the size of the file; LoadError where it holds no byte, or a Git LFS pointer."""
    size = os.fstat(file.fileno()).st_size
    head = file.read(len(LFS_PREFIX))
    file.seek(0)
    if head == LFS_PREFIX:
        advice = "fetch the data with `git lfs pull`"
        raise LfsPointerError(str(path), None, "a reconstruction's data", "a Git LFS pointer", advice)
    if size == 0:
        raise TruncatedFileError(str(path), None, "a reconstruction's data", "an empty file", _COPY_AGAIN)
    return size


def read_bytes(path: Path) -> bytes:
    """Return the content of ``path``; errors as of `open_input`."""
    file, _ = open_input(path)
    with file:
        try:
            return file.read()
        except OSError as error:
            raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> UnreadableFileError:
    got = error.strerror or type(error).__name__
    return UnreadableFileError(str(path), None, "a readable file", got, "check its permissions and its disk")
