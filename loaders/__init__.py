"""Reads reconstructions of any format into one columnar model."""

from sfm_audit.loaders.datasets.discover import Discovery, ModelRef, discover
from sfm_audit.loaders.datasets.fingerprint import InputFile, input_files
from sfm_audit.loaders.errors import (
    LfsPointerError,
    LoadError,
    MalformedFileError,
    MissingFileError,
    Position,
    TruncatedFileError,
    UnreadableFileError,
)
from sfm_audit.loaders.model import (
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
from sfm_audit.loaders.opening import open_model

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
