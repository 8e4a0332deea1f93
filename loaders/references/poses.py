"""A list of poses, before it is known which images of a model are meant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.model import rotation_from_quat
from sfm_audit.loaders.paths.locations import InputPath

ADVICE: Final = "see docs/witnesses.md for the formats of references"
MAX_POSES: Final = 5_000_000
_MIN_QUAT: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class PoseList:
    """Poses of n cameras, of the file or folder ``location``.

    rotation: (n, 3, 3) camera from world.    centre: (n, 3) world frame.    is_metric: whether the unit is the metre.
    Rows that are not finite are poses that the file does not know.
    One of these says which image a row is of, or none where the row itself does (frame 0, 1, ...):
    names: of the images.    seconds: (n,) ascending, so that poses in between can be interpolated.
    scene: (n,) which scene of a data set each row is of, where the file says so.
    """

    location: str
    rotation: FloatArray
    centre: FloatArray
    is_metric: bool
    names: tuple[str, ...] | None = None
    seconds: FloatArray | None = None
    scene: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.centre)


def inverse_poses(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the (n, 3) centres of cameras whose poses are ``camera from world``."""
    with np.errstate(over="ignore", invalid="ignore"):
        centre: FloatArray = -np.einsum("nij,ni->nj", rotation, translation)
    return centre


def rotations_of(path: InputPath, quat_wxyz: FloatArray, lines: list[int]) -> FloatArray:
    """Return (n, 3, 3) rotations of quaternions (n, 4) of any length; those that are not finite give NaN.

    Raises
    ------
    MalformedFileError
        A quaternion is 0, and no rotation.
    """
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
        zero = np.flatnonzero(length[:, 0] < _MIN_QUAT)
        if len(zero):
            position = Position("line", lines[int(zero[0])])
            raise MalformedFileError(str(path), position, "a quaternion", "one of length 0", ADVICE)
        return rotation_from_quat(quat_wxyz / length)


def check_rotations(path: InputPath, rotation: FloatArray, lines: list[int]) -> FloatArray:
    """Return the rotations nearest to matrices (n, 3, 3); rows that are not finite give NaN.

    Raises
    ------
    MalformedFileError
        A matrix mirrors, or is farther from a rotation than printing rounds.
    """
    out = np.full(rotation.shape, np.nan)
    finite = np.flatnonzero(np.isfinite(rotation).all(axis=(1, 2)))
    if not len(finite):
        return out
    stored = rotation[finite]
    with np.errstate(all="ignore"):
        far = np.abs(np.einsum("nji,njk->nik", stored, stored) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero(~((far < _MAX_DEVIATION) & (np.linalg.det(stored) > 0)))
    if len(wrong):
        position = Position("line", lines[int(finite[wrong[0]])])
        raise MalformedFileError(str(path), position, "a rotation matrix", "one that is none", ADVICE)
    left, _, right = np.linalg.svd(stored)
    out[finite] = left @ right
    return out


_MAX_DEVIATION: Final = 0.01
