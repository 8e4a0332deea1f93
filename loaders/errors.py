"""Errors for inputs that cannot be read: which file, where, what was expected, what was found, what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
        """One line, whatever the parts contain."""
        where = f"{self.path}: {self.position}" if self.position else self.path
        return " ".join(f"{where}: expected {self.wanted}, found {self.got}; {self.advice}".split())


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
