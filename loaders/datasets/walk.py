"""Which folders lie below a folder? A walk that ends, stays inside, and says what it left out."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sfm_audit.loaders.errors import LoadError, UnreadableFileError

Parts = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WalkLimits:
    """Where a walk stops: names below the root, folders looked into, seconds."""

    max_depth: int = 64
    max_folders: int = 1_000_000
    max_seconds: float = 1800.0


LIMITS: Final = WalkLimits()


@dataclass(slots=True)
class Walk:
    """What a walk met beside the folders that it visited.

    errors : folders that cannot be searched, and one for all that was left out because of a limit
    links_out : links to folders outside of the root, which were not followed
    """

    errors: list[LoadError] = field(default_factory=list)
    links_out: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder that was visited: the names that lead to it from the root, and the names in it."""

    parts: Parts
    path: Path
    folders: tuple[str, ...]
    files: tuple[str, ...]


def walk(
    root: Path,
    visit: Callable[[Folder], Sequence[str]],
    *,
    follow_links: bool = False,
    limits: WalkLimits | None = None,
) -> Walk:
    """Visit the folders at and below ``root``, each once, in the order of their names.

    A link inside the root is followed, and a folder that several lead to is visited under the first of its names, so
    loops end. A link to a folder outside is not followed unless ``follow_links``. ``root`` itself may be a link.

    Parameters
    ----------
    visit : called with every folder; returns which of its folders to go into, in order
    limits : None for `LIMITS`
    """
    limits = limits or LIMITS
    real_root, met, left_out = os.path.realpath(root), Walk(), _LeftOut(limits)
    visited: set[tuple[int, int]] = set()
    stack: list[Parts] = [()]
    while stack:
        parts = stack.pop()
        path = root.joinpath(*parts)
        if left_out.at(parts, path):
            continue
        try:
            if parts and not follow_links and path.is_symlink() and not _is_inside(path, real_root):
                met.links_out.append(str(path))
                continue
            there = path.stat()
            if (there.st_dev, there.st_ino) in visited:
                continue
            visited.add((there.st_dev, there.st_ino))
            left_out.num_folders += 1
            folder = _listed(parts, path)
        except OSError as error:
            got = error.strerror or type(error).__name__
            met.errors.append(UnreadableFileError(str(path), None, "a readable folder", got, "check its permissions"))
            continue
        stack += [(*parts, name) for name in reversed(visit(folder))]
    if left_out.num:
        met.errors.append(left_out.error(root))
    return met


def leads_out(path: Path, root: Path) -> bool:
    """Whether ``path`` is a link that ends outside of ``root``."""
    return path.is_symlink() and not _is_inside(path, os.path.realpath(root))


def _is_inside(path: Path, real_root: str) -> bool:
    real = os.path.realpath(path)
    return real == real_root or real.startswith(real_root.rstrip(os.sep) + os.sep)


def _listed(parts: Parts, path: Path) -> Folder:
    folders: list[str] = []
    files: list[str] = []
    with os.scandir(path) as entries:
        for entry in entries:
            (folders if _is_folder(entry) else files).append(entry.name)
    return Folder(parts, path, tuple(sorted(folders)), tuple(sorted(files)))


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return False


class _LeftOut:
    """Counts the folders that are not visited because of a limit."""

    def __init__(self, limits: WalkLimits) -> None:
        self.num = 0
        self.num_folders = 0
        self._limits = limits
        self._example = ""
        self._why = ""
        self._end = time.monotonic() + limits.max_seconds

    def at(self, parts: Parts, path: Path) -> bool:
        """Whether a folder is left out."""
        limits = self._limits
        why = ""
        if len(parts) > limits.max_depth:
            why = f"more than {limits.max_depth} folders deep"
        elif self.num_folders >= limits.max_folders:
            why = f"after {limits.max_folders} folders"
        elif time.monotonic() > self._end:
            why = f"after {limits.max_seconds:g} s"
        if not why:
            return False
        if not self.num:
            text = str(path)
            self._example, self._why = text if len(text) <= 200 else f"{text[:100]}...{text[-60:]}", why
        self.num += 1
        return True

    def error(self, root: Path) -> LoadError:
        """One line for all that was left out."""
        got = f"{self.num} folders and what is below them, {self._why}, such as {self._example}"
        return LoadError(str(root), None, "a data set that can be searched", got, "name the folders with the models")
