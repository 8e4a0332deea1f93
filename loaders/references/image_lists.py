"""Poses by image name: COLMAP's images file alone, and the ground truth of the Image Matching Challenges.

ETH3D's ground truth is a COLMAP text model (dslr_calibration_*/images.txt, metres). A models' folder is read as every
model is; an images.txt without cameras and points beside it by itself.
IMC (https://www.kaggle.com/competitions/image-matching-challenge-2022 to 2025): CSV with ``rotation_matrix`` (9 numbers
row by row) and ``translation_vector``, camera from world; the numbers are separated by blanks in 2022 (calibration.csv,
``image_id`` without the ending, unit of the scene) and by semicolons later (train_labels.csv; ``image_path`` in 2023,
``image_name`` in 2024, ``image`` in 2025; ``dataset`` and ``scene``); nan where an image has no pose.
"""

from __future__ import annotations

import csv
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.colmap.text import read_images
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextFile, parse_floats, read_text
from sfm_audit.loaders.references.poses import (
    ADVICE,
    MAX_POSES,
    PoseList,
    check_rotations,
    inverse_poses,
    rotations_of,
)

_NAMES: Final = ("image_path", "image_name", "image", "image_id")
_ROTATION, _TRANSLATION = "rotation_matrix", "translation_vector"
_MAX_CELL: Final = 10_000


def pose_list(path: InputPath, names: tuple[str, ...], poses: FloatArray) -> PoseList:
    """Return the poses of a model's images: (n, 7) quaternions w x y z and translations, camera from world."""
    quats = poses[:, :4].copy()
    quats[(np.abs(quats) < 1e-6).all(axis=1)] = np.nan
    rotation = rotations_of(path, quats, [1] * len(quats))
    return PoseList(str(path), rotation, inverse_poses(rotation, poses[:, 4:]), is_metric=False, names=names)


def read_images_txt(path: InputPath) -> PoseList:
    """Read COLMAP's images.txt by itself; LoadError where it is none."""
    file = read_text(path)
    images = read_images(file)
    if not images.name or (file.stated_count or 0) > len(images.name):
        raise file.truncated(f"{file.stated_count or 'some'} images", f"{len(images.name)}")
    return pose_list(path, images.name, images.poses)


def read_imc(path: InputPath) -> PoseList:
    """Read the ground truth of an Image Matching Challenge; LoadError where it is none."""
    file = read_text(path, ADVICE)
    header = _fields(file, 1, file.lines[0])
    named = next((name for name in _NAMES if name in header), None)
    missing = [name for name in (_ROTATION, _TRANSLATION) if name not in header]
    if named is None or missing:
        raise file.malformed(1, f"the columns {_ROTATION}, {_TRANSLATION} and one of {', '.join(_NAMES)}", str(header))
    at = {name: header.index(name) for name in header}
    names, scenes, lines = [], [], []
    rotations, translations = [], []
    for line, record in enumerate(file.lines[1:], start=2):
        if not record.strip():
            continue
        cells = _fields(file, line, record)
        if len(cells) != len(header):
            raise file.malformed(line, f"{len(header)} cells, as the first line has", f"{len(cells)}")
        names.append(cells[at[named]])
        scenes.append(cells[at["scene"]] if "scene" in at else "")
        rotations.append(_numbers(file, line, cells[at[_ROTATION]], 9))
        translations.append(_numbers(file, line, cells[at[_TRANSLATION]], 3))
        lines.append(line)
        if len(lines) > MAX_POSES:
            raise file.malformed(line, f"at most {MAX_POSES} poses", "more")
    if not lines:
        raise file.truncated("poses", "none")
    if not file.is_terminated:
        raise file.truncated("a line end after the last line", "none, so its last number may be cut")
    rotation = check_rotations(path, np.array(rotations).reshape(-1, 3, 3), lines)
    centre = inverse_poses(rotation, np.array(translations))
    return PoseList(
        str(path), rotation, centre, is_metric=False, names=tuple(names), scene=tuple(scenes) if any(scenes) else ()
    )


def _fields(file: TextFile, line: int, record: bytes) -> list[str]:
    try:
        text = record.decode("utf-8-sig").strip("\r")
        return next(csv.reader([text], strict=True))
    except (UnicodeDecodeError, csv.Error, StopIteration) as error:
        raise file.malformed(line, "a line of CSV in UTF-8", str(error)) from error


def _numbers(file: TextFile, line: int, cell: str, num: int) -> FloatArray:
    tokens = cell[:_MAX_CELL].replace(";", " ").encode().split()
    if len(tokens) != num:
        raise MalformedFileError(str(file.path), Position("line", line), f"{num} numbers", f"{len(tokens)}", ADVICE)
    return parse_floats(file, line, tokens, f"{num} values")
