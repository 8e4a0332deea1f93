"""What is a set of poses? Rotations and centres, from quaternions and translations as tables hold them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import rotation_from_quat

_DIGITS: Final = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of n images.

    rotation: (n, 3, 3) camera from world.    centre: (n, 3) of the cameras, world frame, model units.
    """

    rotation: FloatArray
    centre: FloatArray

    def __len__(self) -> int:
        return len(self.centre)

    @classmethod
    def of(cls, quat_wxyz: FloatArray, translation: FloatArray) -> Poses:
        """Make poses of quaternions (n, 4), of any length but 0, and translations (n, 3), both camera from world."""
        unit = quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
        rotation = rotation_from_quat(unit)
        return cls(rotation, -np.einsum("nij,ni->nj", rotation, translation))

    def take(self, idxs: IntArray | BoolArray) -> Poses:
        """Return some of the poses."""
        return Poses(self.rotation[idxs], self.centre[idxs])


def camera_centres(quat_wxyz: FloatArray, translation: FloatArray) -> FloatArray:
    """Return (n, 3) centres, world frame, of stored poses camera from world; not finite where a pose is not."""
    with np.errstate(all="ignore"):
        rotation = rotation_from_quat(quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True))
        centre: FloatArray = -np.einsum("nij,ni->nj", rotation, translation)
    return centre


def usable_poses(quat_wxyz: FloatArray, translation: FloatArray) -> BoolArray:
    """Return which of n poses can be compared: finite, and the quaternion is not 0. Tables are not trusted."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quat_wxyz, axis=1)
        far = np.abs(translation).max(axis=1, initial=0.0)
    usable: BoolArray = np.isfinite(length) & (length > 1e-6) & (length < 1e6) & np.isfinite(far) & (far < 1e12)
    return usable


def natural_order(names: Sequence[str]) -> list[int]:
    """Return the order of names in which IMG_9 comes before IMG_10: the order in which photos were taken, mostly."""

    def key(idx: int) -> tuple[list[str | tuple[int, str]], str]:
        parts = _DIGITS.split(names[idx])
        return [(len(p.lstrip("0")), p.lstrip("0")) if i % 2 else p for i, p in enumerate(parts)], names[idx]

    return sorted(range(len(names)), key=key)
