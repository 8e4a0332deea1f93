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
    MalformedFileError,
    MissingFileError,
    TruncatedFileError,
    UnreadableFileError,
)
from sfm_audit.loaders.paths.locations import Entry, InputPath, RemotePath

LFS_PREFIX: Final = b"version https://git-lfs.github.com/spec/"
_COPY_AGAIN: Final = "copy or export it again"


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


def names_in(folder: InputPath) -> tuple[str, ...]:
    """Return the names in a folder; none where it cannot be listed."""
    try:
        if isinstance(folder, RemotePath):
            return tuple(listing_of(folder))
        return tuple(path.name for path in folder.iterdir())
    except (OSError, LoadError):
        return ()


def is_folder(path: InputPath) -> bool:
    """Whether ``path`` is a folder; LoadError where an object store does not answer."""
    if isinstance(path, Path):
        return path.is_dir()
    from sfm_audit.loaders.paths.remote import kind_of  # noqa: PLC0415 - as above

    return kind_of(path) == "folder"


def open_input(path: InputPath, *, only_head: bool = False, may_be_empty: bool = False) -> tuple[BufferedReader, int]:
    """Open a regular file that is no Git LFS pointer, and not empty unless it ``may_be_empty``.

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
        Where the file holds no byte at all and must hold some.
    """
    file, size = _open_remote(path, only_head=only_head) if isinstance(path, RemotePath) else _open_local(path)
    try:
        with reading(path):
            _check_content(path, file, size, may_be_empty=may_be_empty)
    except LoadError:
        file.close()
        raise
    return file, size


def _open_remote(path: RemotePath, *, only_head: bool) -> tuple[BufferedReader, int]:
    from sfm_audit.loaders.paths.remote import HEAD_BYTES, PIECE_BYTES, open_remote  # noqa: PLC0415 - as above

    return open_remote(path, HEAD_BYTES if only_head else PIECE_BYTES)


def _open_local(path: Path) -> tuple[BufferedReader, int]:
    if path.is_symlink() and not path.exists():
        got = f"a link to nothing ({os.readlink(path)})"  # noqa: PTH115 - the text of the link, whatever it is
        raise MissingFileError(str(path), None, "a file", got, _COPY_AGAIN)
    return open_regular(path, "name a file, or put one in its place")


def open_regular(path: Path, advice: str = "put a regular file in its place") -> tuple[BufferedReader, int]:
    """Open a regular file of this machine; every file that this program reads is opened here.

    A pipe, device or socket is refused without waiting for its other end: nothing is opened that was not asked first,
    and what was opened is asked again, in case it was exchanged in between.

    Returns
    -------
    tuple
        The file, positioned at its start, and its size in bytes.

    Raises
    ------
    MissingFileError, UnreadableFileError
        There is no such file, it is no regular one, or it cannot be opened.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise _not_regular(path, mode, advice)
        file = _open_without_waiting(path)
    except FileNotFoundError:
        raise MissingFileError(str(path), None, "a file", "nothing", "check the path") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        raise _unreadable(path, error) from error
    opened = os.fstat(file.fileno())
    if not stat.S_ISREG(opened.st_mode):
        file.close()
        raise _not_regular(path, opened.st_mode, advice)
    return file, opened.st_size


def read_small(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file of this machine that should be small, such as a file of settings.

    Raises
    ------
    LoadError
        As of `open_regular`; MalformedFileError for a file of more than ``max_bytes``, of which no more is read.
    """
    file, _ = open_regular(path)
    with file, reading(path):
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise MalformedFileError(str(path), None, f"at most {max_bytes} bytes", "more", "name another file")
    return content


def _open_without_waiting(path: Path) -> BufferedReader:
    """Open a file; where a pipe has taken its place in the meantime, do not wait for the pipe's writer."""
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
    return os.fdopen(os.open(path, flags), "rb")


def _not_regular(path: Path, mode: int, advice: str) -> UnreadableFileError:
    return UnreadableFileError(str(path), None, "a file", _kind_of(mode), advice)


def _kind_of(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a named pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return kinds.get(stat.S_IFMT(mode), "neither a file nor a folder")


def _check_content(path: InputPath, file: BufferedReader, size: int, *, may_be_empty: bool) -> None:
    """Raise LoadError where the file holds a Git LFS pointer, or no byte and must hold some."""
    head = file.peek(len(LFS_PREFIX))[: len(LFS_PREFIX)]  # reading and going back would ask a store twice
    if head == LFS_PREFIX:
        advice = "fetch the data with `git lfs pull`"
        raise LfsPointerError(str(path), None, "data", "a Git LFS pointer", advice)
    if size == 0 and not may_be_empty:
        raise TruncatedFileError(str(path), None, "data", "an empty file", _COPY_AGAIN)


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


def _unreadable(path: InputPath, error: OSError | ValueError) -> UnreadableFileError:
    got = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return UnreadableFileError(str(path), None, "a readable file", got, "check its permissions and its disk")
