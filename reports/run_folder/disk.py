"""How does a file reach the disk whole? Under a temporary name, flushed, renamed; what refuses is one kind of error."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from sfm_audit.reports.errors import OutputError


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


def flush_folder(folder: Path) -> None:
    """Make a rename survive a power cut; Windows has no such call for folders."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
