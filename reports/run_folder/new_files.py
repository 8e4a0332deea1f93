"""How does a result reach the disk? Under a temporary name first, and over something only if that was asked for."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sfm_audit.reports.run_folder.disk import write_whole, writing


class OutputExistsError(Exception):
    """Something lies where a result should go; the message is one line for the user."""


def check_free(path: Path, *, force: bool, replaceable: frozenset[str] = frozenset()) -> None:
    """Refuse to write over something.

    Parameters
    ----------
    path : where a file (or, with ``replaceable``, a folder) will be written
    force : whether an existing one may be replaced
    replaceable : the names of the files that a folder may hold to be replaced; a folder with others never is

    Raises
    ------
    OutputExistsError
        Something is there that stays.
    """
    if not os.path.lexists(path):
        return
    if not replaceable:
        if path.is_dir():
            raise OutputExistsError(f"{path}: is a folder; name a file")
        if not force:
            raise OutputExistsError(f"{path}: exists; choose another name, or replace it with --force")
        return
    if not path.is_dir():
        raise OutputExistsError(f"{path}: is a file; name a folder")
    with writing(path):
        names = sorted(child.name for child in path.iterdir())
    foreign = [name for name in names if name not in replaceable]
    if foreign:
        raise OutputExistsError(f"{path}: holds {foreign[0]!r}, which is none of a model's files; choose a new folder")
    if names and not force:
        raise OutputExistsError(f"{path}: holds a model; choose another folder, or replace it with --force")


def write_file(path: Path, content: bytes) -> None:
    """Write a file that is there completely or not at all; OutputError where the operating system refuses."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, [content])


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Give an empty folder that takes the place of ``path`` when the block ends well, and vanishes when it does not.

    Raises
    ------
    OutputError
        Where the operating system refuses. What lay at ``path`` is then still there.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".tmp-sfm-audit-{os.getpid()}")
    old = target.with_name(f".old-sfm-audit-{os.getpid()}")
    with writing(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
    try:
        yield temporary
        with writing(path):
            if target.exists():
                target.rename(old)
            try:
                temporary.rename(target)
            except BaseException:
                if old.exists():
                    old.rename(target)
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
