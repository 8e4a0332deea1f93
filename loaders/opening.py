"""The one function that reads a model, whatever its format."""

from __future__ import annotations

from pathlib import Path

from sfm_audit.loaders.assembly.assemble import assemble
from sfm_audit.loaders.formats import format_of
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.locations import parse_location


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
