"""Errors for inputs that cannot be read: which file, where, what was expected, what was found, what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal

_MAX_PART: Final = 600  # characters of a part of a message; names in files may be as long as the file


@dataclass(frozen=True, slots=True)
class Position:
    """A place in a file: a byte offset in binary files, a 1-based line number in text files or row of a table."""

    unit: Literal["byte", "line", "row"]
    number: int

    def __str__(self) -> str:
        return f"{self.unit} {self.number}"


class LoadError(Exception):
    """An input that cannot be read.

    Parameters
    ----------
    path : location of the file or folder, as given by the user and joined with the path below it
    position : where in the file, or None when the file as a whole is at fault
    wanted : what a valid file holds there
    got : what was found
    advice : what the user can do about it
    """

    def __init__(self, path: str, position: Position | None, wanted: str, got: str, advice: str) -> None:
        super().__init__(path, position, wanted, got, advice)
        self.path = path
        self.position = position
        self.wanted = wanted
        self.got = got
        self.advice = advice

    def __str__(self) -> str:
        """One line of bounded length, whatever the parts contain."""
        where = f"{self.path}: {self.position}" if self.position else self.path
        wanted, got, advice = (_bounded(part) for part in (self.wanted, self.got, self.advice))
        return " ".join(f"{where}: expected {wanted}, found {got}; {advice}".split())


def _bounded(part: str) -> str:
    return part if len(part) <= _MAX_PART else f"{part[:_MAX_PART]}..."


@contextmanager
def called(name: str) -> Iterator[None]:
    """While errors are raised here, the file is called so, not by its path on this machine."""
    try:
        yield
    except LoadError as error:
        error.path, error.args = name, (name, *error.args[1:])
        raise


class MissingFileError(LoadError):
    """A file or folder that a reconstruction needs does not exist."""


class TruncatedFileError(LoadError):
    """The file ends inside a record."""


class MalformedFileError(LoadError):
    """The file's content is not what its format allows."""


class LfsPointerError(LoadError):
    """The file is a Git LFS pointer, not the data it stands for."""


class UnreadableFileError(LoadError):
    """The operating system refuses to read the file, or it is no regular file."""
