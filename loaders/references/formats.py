"""Formats of poses: which one is a file or folder, and where in a tree of references is that of a model."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np

from sfm_audit.loaders.errors import LoadError, MalformedFileError, MissingFileError, UnreadableFileError
from sfm_audit.loaders.evidence import NotAsked, ReferencePoses
from sfm_audit.loaders.formats import marks_model, model_file_names
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.opening import open_model
from sfm_audit.loaders.paths.files import exists, is_folder, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath, parse_location
from sfm_audit.loaders.references.image_lists import pose_list, read_images_txt, read_imc
from sfm_audit.loaders.references.matching import poses_of_images
from sfm_audit.loaders.references.poses import ADVICE, PoseList
from sfm_audit.loaders.references.trajectories import (
    EUROC_VALUES,
    KITTI_VALUES,
    TUM_VALUES,
    read_euroc,
    read_kitti,
    read_tum,
)

IMAGES_TXT: Final = "images.txt"
_HEAD_BYTES: Final = 1 << 16
_KINDS: Final = "a COLMAP model, images.txt, a TUM, KITTI or EuRoC trajectory, or the CSV of an IMC"


def reference_of(model: SparseModel, reference: str, below: str, scene: str) -> ReferencePoses | NotAsked:
    """Return the poses that a reference has for the images of a model.

    Parameters
    ----------
    reference : a file of poses, a model folder, or a tree with a model at the same relative path
    below : that path, with slashes (`loaders.datasets.discover.ModelRef.below`)    scene : of the model

    Returns
    -------
    ReferencePoses
        `NotAsked` where the reference has nothing on the model: its images are not in it.

    Raises
    ------
    LoadError
        The reference cannot be read.
    """
    place = place_of_reference(reference, below)
    if isinstance(place, NotAsked):
        return place
    poses = read_poses(place)
    try:
        return poses_of_images(poses, model.images.name, scene)
    except LoadError as error:
        return NotAsked(str(error))


def place_of_reference(reference: str, below: str) -> InputPath | NotAsked:
    """Return the file or folder that holds the poses of a model; `NotAsked` where the tree has none for it.

    Raises
    ------
    LoadError
        There is nothing of that name.
    """
    root = parse_location(reference)
    if not exists(root):
        raise MissingFileError(str(root), None, _KINDS, "nothing", "check the path")
    if not is_folder(root) or _holds_poses(root):
        return root
    place = root
    for part in PurePosixPath(below).parts:
        place = place / part
    if below and is_folder(place) and _holds_poses(place):
        return place
    wanted = f"a model at {below}" if below else "a model"
    return NotAsked(str(MissingFileError(str(root), None, wanted, "none", "put it there as in the tree of models")))


def _holds_poses(folder: InputPath) -> bool:
    return marks_model(model_file_names(folder)) or exists(folder / IMAGES_TXT)


def read_poses(path: InputPath) -> PoseList:
    """Read poses of any known format; LoadError where they cannot be read."""
    if is_folder(path):
        if exists(path / IMAGES_TXT) and not exists(path / "cameras.txt") and not exists(path / "images.bin"):
            return read_images_txt(path / IMAGES_TXT)
        return _of_model(path)
    if path.name in {IMAGES_TXT, "images.bin"}:
        folder = path.parent if isinstance(path, Path) else path.folder
        if folder is not None and len(model_file_names(folder)) > 1:
            return _of_model(folder)
        if path.name == IMAGES_TXT:
            return read_images_txt(path)
    return _of_text(path)


def _of_model(folder: InputPath) -> PoseList:
    images = open_model(folder if isinstance(folder, Path) else str(folder)).images
    if not len(images):
        raise MalformedFileError(str(folder), None, "a model with images", "none", ADVICE)
    poses = np.hstack([images.quat_cam_from_world_wxyz, images.translation_cam_from_world])
    return pose_list(folder, images.name, poses)


def _of_text(path: InputPath) -> PoseList:
    """Read a text file whose first lines say what it is."""
    file, _ = open_input(path, only_head=True)
    with file, reading(path):
        head = file.read(_HEAD_BYTES)
    lines = [line.strip() for line in head.splitlines()]
    first = next((line for line in lines if line and not line.startswith(b"#")), b"")
    if b"rotation_matrix" in lines[0]:
        return read_imc(path)
    if b"," in first and len(first.split(b",")) in EUROC_VALUES:
        return read_euroc(path)
    if len(first.split()) == KITTI_VALUES:
        return read_kitti(path)
    if len(first.split()) == TUM_VALUES:
        return read_tum(path)
    got = f"a file whose first line has {len(first.split())} values"
    raise UnreadableFileError(str(path), None, _KINDS, got, ADVICE)
