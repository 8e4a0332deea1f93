"""How does a file reach the disk whole? Under a temporary name, flushed, renamed. What is read is a plain file."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pyarrow as pa

from sfm_audit.reports.errors import OutputError

RUN_JSON: Final = "run.json"
_NO_WAITING: Final = getattr(os, "O_NONBLOCK", 0)  # opening a pipe that nobody writes to waits for ever
_NO_LINKS: Final = getattr(os, "O_NOFOLLOW", 0)
_BINARY: Final = getattr(os, "O_BINARY", 0)


class NotPlainError(OSError):
    """What lies there is no plain file, or a larger one than is read."""


def open_plain(path: Path, *, follow_links: bool = True) -> io.BufferedReader:
    """Open a plain file for reading; never a pipe, a device or a folder, which might not end.

    Raises
    ------
    OSError
        It is not there or cannot be read; NotPlainError where it is something else (a link where none is followed).
    """
    if not follow_links and path.is_symlink():
        raise NotPlainError(None, "a link")
    handle = os.open(path, os.O_RDONLY | _NO_WAITING | _BINARY | (0 if follow_links else _NO_LINKS))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise NotPlainError(None, "no plain file")
    return os.fdopen(handle, "rb")


def read_plain(path: Path, max_bytes: int, *, follow_links: bool = True) -> bytes:
    """Return the content of a plain file of at most ``max_bytes``; errors as of `open_plain`."""
    with open_plain(path, follow_links=follow_links) as file:
        num_bytes = os.fstat(file.fileno()).st_size
        if num_bytes > max_bytes:
            raise NotPlainError(None, f"larger than {max_bytes / 1e6:.3g} MB")
        return file.read(num_bytes)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the operating system refuses into an OutputError on ``path``."""
    try:
        yield
    except OSError as error:
        raise OutputError(path, error.strerror or str(error)) from error


def write_whole(path: Path, content: Iterable[bytes | pa.Buffer]) -> None:
    """Write a file that is there completely or not at all, also after a power cut; its folder exists.

    Raises
    ------
    OutputError
        The operating system refuses.
    """
    temporary = path.with_name(f".tmp-sfm-audit-{os.getpid()}-file")
    with writing(path):
        try:
            with temporary.open("wb") as file:
                for piece in content:
                    file.write(piece)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        flush_folder(path.parent)


def append_line(path: Path, line: bytes) -> None:
    """Add a line to a file, so that it is on the disk when this returns; OutputError where that is refused."""
    with writing(path), path.open("ab") as file:
        file.write(line + b"\n")
        file.flush()
        os.fsync(file.fileno())


def flush_folder(folder: Path) -> None:
    """Make a rename survive a power cut; Windows has no such call for folders."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
