"""What is a format of model files? The record that a reader fills in; `formats` holds the list of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.locations import InputPath

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, slots=True)
class ModelWriter:
    """How a model is written again in its own format, by way of pycolmap.

    read : returns the model's files as pycolmap's reconstruction, names as in the model given
    write : writes a reconstruction into an existing folder
    """

    read: Callable[[SparseModel], pycolmap.Reconstruction]
    write: Callable[[pycolmap.Reconstruction, Path], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFormat:
    """One format of model files.

    Attributes
    ----------
    name : str
        What the column ``file_format`` of the tables holds.
    required, optional : tuple of str
        Names of the files in a model folder. A folder with one of the required files counts as a model, so that an
        incomplete model is reported instead of passed over. A name with a ``*`` stands for all names like it; where a
        folder holds several, the reader says which it wants.
    folders : tuple of str
        Folders in a model folder of this machine, all files of which, at any depth, may be read for the model.
    read : callable
        Reads the model in a folder; raises `loaders.errors.LoadError` where that cannot be done.
    count_images : callable
        Returns the number of images in a folder's model without reading all of it; raises LoadError.
    check : callable or None
        Raises LoadError where the records of a folder's files do not fill them; keeps nothing in memory. It is asked
        before large files are hashed.
    writer : ModelWriter or None
        For `filter --model-out`; None where models of this format are only read.
    keypoint_scales : callable or None
        Returns (M,) sizes, px, of the keypoints of a model's observations, for ``--noise keypoint``; its second
        argument is the model's location as messages show it. None where the format has none.
    """

    name: str
    required: tuple[str, ...]
    read: Callable[[InputPath], RawModel]
    count_images: Callable[[InputPath], int]
    optional: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()
    check: Callable[[InputPath], None] | None = None
    writer: ModelWriter | None = None
    keypoint_scales: Callable[[SparseModel, str], FloatArray] | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all files, the required ones first."""
        return self.required + self.optional

    def matches(self, names: Collection[str]) -> bool:
        """Whether a folder that holds these names holds a complete model of this format."""
        return all(matching(name, names) for name in self.required)

    def among(self, names: Collection[str]) -> tuple[str, ...]:
        """Return those of ``names`` that are files of this format, the required ones first."""
        inside = tuple(f"{folder}/" for folder in self.folders)
        found = [found for name in self.files for found in matching(name, names)]
        return tuple(dict.fromkeys([*found, *sorted(name for name in names if inside and name.startswith(inside))]))

    def below(self, folder: Path) -> tuple[str, ...]:
        """Return the names of all files in this format's folders, as ``keypoints/SIFT/1.jpg.kpt``, sorted."""
        return tuple(sorted(name for start in self.folders for name in _files_below(folder / start, start)))


def _files_below(folder: Path, name: str) -> list[str]:
    """Return the files below a folder; links to folders are followed once, what cannot be listed holds none."""
    found: list[str] = []
    seen: set[str] = set()
    waiting = [(folder, name)]
    while waiting:
        here, prefix = waiting.pop()
        real = os.path.realpath(here)
        if real in seen:
            continue
        seen.add(real)
        try:
            entries = list(os.scandir(here))
        except OSError:
            continue
        for entry in entries:
            below = f"{prefix}/{entry.name}"
            if entry.is_dir():
                waiting.append((here / entry.name, below))
            else:
                found.append(below)
    return found


def matching(pattern: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return those of ``names`` that a format's name means: itself, or all that its ``*`` fits, sorted."""
    if "*" in pattern:
        return tuple(sorted(name for name in names if fnmatchcase(name, pattern)))
    return (pattern,) if pattern in names else ()
