"""COLMAP's model files by way of pycolmap: for writing, where pycolmap is the judge of what COLMAP reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.model_format import ModelWriter

if TYPE_CHECKING:
    import pycolmap


def _read_binary(model: SparseModel) -> pycolmap.Reconstruction:
    import pycolmap  # noqa: PLC0415 - costs what a run that writes no model need not pay

    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_binary(model.location)
    return reconstruction


def _read_text(model: SparseModel) -> pycolmap.Reconstruction:
    """Read text files; COLMAP takes a name up to its first blank, this package the rest of the line."""
    import pycolmap  # noqa: PLC0415 - as above

    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(model.location)
    for image_id, name in zip(model.images.image_id.tolist(), model.images.name, strict=True):
        if " " in name and image_id in reconstruction.images:
            reconstruction.images[image_id].name = name
    return reconstruction


def _write_binary(reconstruction: pycolmap.Reconstruction, folder: Path) -> None:
    reconstruction.write_binary(str(folder))


def _write_text(reconstruction: pycolmap.Reconstruction, folder: Path) -> None:
    reconstruction.write_text(str(folder))


BINARY_WRITER: Final = ModelWriter(_read_binary, _write_binary)
TEXT_WRITER: Final = ModelWriter(_read_text, _write_text)
