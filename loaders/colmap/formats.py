"""COLMAP's two formats of model files, as records for `loaders.formats`."""

from __future__ import annotations

import dataclasses
from typing import Final

from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.colmap import binary, text
from sfm_audit.loaders.colmap.database import read_keypoint_scales
from sfm_audit.loaders.colmap.other_format import compare_with_text, count_records, mention_ignored_binary
from sfm_audit.loaders.colmap.with_pycolmap import BINARY_WRITER, TEXT_WRITER
from sfm_audit.loaders.model import Finding
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

_REQUIRED: Final = ("cameras", "images", "points3D")
_OPTIONAL: Final = ("rigs", "frames")


def _names(stems: tuple[str, ...], suffix: str) -> tuple[str, ...]:
    return tuple(f"{stem}{suffix}" for stem in stems)


def _read_binary(folder: InputPath) -> RawModel:
    raw = binary.read_model(folder)
    return _with_findings(compare_with_text(folder, raw), raw)


def _read_text(folder: InputPath) -> RawModel:
    raw = text.read_model(folder)
    return _with_findings(mention_ignored_binary(folder), raw)


def _with_findings(findings: tuple[Finding, ...], raw: RawModel) -> RawModel:
    return dataclasses.replace(raw, findings=findings + raw.findings)


def _count_binary(folder: InputPath) -> int:
    path = folder / "images.bin"
    file, size = open_input(path, only_head=True)
    with file, reading(path):
        return binary.num_images(path, file.read(8), size)


def _count_text(folder: InputPath) -> int:
    return count_records(folder / "images.txt")


BINARY: Final = ModelFormat(
    name="binary",
    required=_names(_REQUIRED, ".bin"),
    optional=_names(_OPTIONAL, ".bin"),
    read=_read_binary,
    count_images=_count_binary,
    check=binary.check_structure,
    writer=BINARY_WRITER,
    keypoint_scales=read_keypoint_scales,
)
TEXT: Final = ModelFormat(
    name="text",
    required=_names(_REQUIRED, ".txt"),
    optional=_names(_OPTIONAL, ".txt"),
    read=_read_text,
    count_images=_count_text,
    check=text.check_structure,
    writer=TEXT_WRITER,
    keypoint_scales=read_keypoint_scales,
)
