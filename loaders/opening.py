"""The functions that read a model: of files, whatever their format, and of a reconstruction in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfm_audit.loaders.assembly.assemble import assemble
from sfm_audit.loaders.colmap import in_memory
from sfm_audit.loaders.formats import format_of
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.locations import parse_location

if TYPE_CHECKING:
    import pycolmap

IN_MEMORY: Final = "pycolmap"
"""``file_format`` of a model that no files were read for."""


def open_model(path: str | Path) -> SparseModel:
    """Read the model in the folder ``path``.

    The first format of `formats.FORMATS` whose files are complete is read: COLMAP's binary files before its text
    files. Where both exist and disagree in their counts, the model's findings say so. With COLMAP's rigs and frames
    the poses are composed from them.

    Parameters
    ----------
    path : a model folder of this machine, or s3://..., gs://...

    Returns
    -------
    SparseModel
        Everything that can be read; every inconsistency is listed in ``findings``; ``location`` is ``path``.

    Raises
    ------
    LoadError
        A file is missing or cannot be read as what it should be.
    """
    folder = parse_location(path)
    model_format = format_of(folder)
    return assemble(model_format.read(folder), str(path), model_format.name)


def from_pycolmap(reconstruction: pycolmap.Reconstruction) -> SparseModel:
    """Take a model out of a reconstruction in memory, without files.

    Parameters
    ----------
    reconstruction : its registered images, with cameras, rigs, frames and points; nothing in it is changed, and what is
        changed in it afterwards does not change the model

    Returns
    -------
    SparseModel
        Equal to what `open_model` reads where ``reconstruction.write_binary`` wrote, findings included;
        ``file_format`` is "pycolmap", ``location`` says that it lies in memory.

    Raises
    ------
    TypeError
        ``reconstruction`` is none.
    LoadError
        A camera model or an image size that the tables do not know.
    """
    if not hasattr(reconstruction, "reg_image_ids"):
        got = type(reconstruction).__name__
        raise TypeError(f"reconstruction: expected a pycolmap.Reconstruction, found {got}; open_model reads a path")
    return assemble(in_memory.raw_model(reconstruction), in_memory.WHERE, IN_MEMORY)
