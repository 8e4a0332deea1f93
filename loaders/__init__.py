"""Reconstructions in, one columnar model out."""

from loaders.colmap import open_model
from loaders.discover import Discovery, ModelRef, discover
from loaders.errors import (
    LfsPointerError,
    LoadError,
    MalformedFileError,
    MissingFileError,
    Position,
    TruncatedFileError,
    UnreadableFileError,
)
from loaders.fingerprint import InputFile, input_files
from loaders.model import (
    CameraRecord,
    CameraTable,
    Finding,
    FindingCode,
    ImageRecord,
    ImageTable,
    InlierSet,
    ObservationTable,
    PointTable,
    SparseModel,
)

__all__ = [
    "CameraRecord",
    "CameraTable",
    "Discovery",
    "Finding",
    "FindingCode",
    "ImageRecord",
    "ImageTable",
    "InlierSet",
    "InputFile",
    "LfsPointerError",
    "LoadError",
    "MalformedFileError",
    "MissingFileError",
    "ModelRef",
    "ObservationTable",
    "PointTable",
    "Position",
    "SparseModel",
    "TruncatedFileError",
    "UnreadableFileError",
    "discover",
    "input_files",
    "open_model",
]
