"""Rotations as other programs store them, as quaternions w x y z."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.foreign.tables import ADVICE
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.locations import InputPath

MAX_DEVIATION: Final = 1e-5
"""Largest element of R^T R - I that counts as rounding, as for the length of COLMAP's quaternions."""


def quats_from_matrices(
    path: InputPath, matrices: FloatArray, names: Sequence[str]
) -> tuple[FloatArray, tuple[Finding, ...]]:
    """Return the quaternions of rotation matrices, of the nearest rotation where a matrix is rounded.

    Parameters
    ----------
    path : the file, for messages
    matrices : (n, 3, 3) as stored; one that is not finite gives a quaternion of NaN
    names : what the images are called

    Returns
    -------
    tuple
        (n, 4) quaternions w x y z of length 1, and a finding where a matrix is farther from a rotation than rounding.

    Raises
    ------
    MalformedFileError
        A matrix that mirrors, or is singular.
    """
    quats = np.full((len(matrices), 4), np.nan)
    finite = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2))).astype(np.int64)
    if not len(finite):
        return quats, ()
    stored = matrices[finite]
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.maximum(np.abs(stored).max(axis=(1, 2), keepdims=True), np.finfo(np.float64).tiny)
        determinants = np.linalg.det(stored / scale)
        wrong = np.flatnonzero(~(determinants > 1e-9))
        if len(wrong):
            row = int(finite[wrong[0]])
            got = f"a matrix with determinant {np.linalg.det(stored[wrong[0]]):.3g} ({names[row]})"
            raise MalformedFileError(str(path), Position("row", row + 1), "a rotation matrix", got, ADVICE)
        left, _, right = np.linalg.svd(stored / scale)
        deviation = np.abs(stored.transpose(0, 2, 1) @ stored - np.eye(3)).max(axis=(1, 2))
    quats[finite] = _from_rotations(left @ right)
    return quats, _not_orthonormal(deviation, finite, names)


def _not_orthonormal(deviation: FloatArray, rows: IntArray, names: Sequence[str]) -> tuple[Finding, ...]:
    wrong = np.flatnonzero(~(deviation <= MAX_DEVIATION))
    if not len(wrong):
        return ()
    example = names[int(rows[wrong[0]])]
    text = f"{len(wrong)} of {len(names)} rotation matrices are none; the nearest rotation was taken, e.g. {example}"
    return (Finding(FindingCode.NON_UNIT_QUATERNIONS, len(wrong), text),)


def _from_rotations(matrices: FloatArray) -> FloatArray:
    """Return (n, 4) quaternions of (n, 3, 3) rotations, w >= 0: the largest component first (Shepperd 1978)."""
    m = matrices
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])  # 4 q_i^2
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]  # 4 w q_i
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    products = np.stack(
        [
            np.stack([squares[0], wx, wy, wz], axis=1),
            np.stack([wx, squares[1], xy, xz], axis=1),
            np.stack([wy, xy, squares[2], yz], axis=1),
            np.stack([wz, xz, yz, squares[3]], axis=1),
        ]
    )
    quats = products[np.argmax(squares, axis=0), np.arange(len(m))]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    result: FloatArray = np.where(quats[:, :1] < 0, -quats, quats)
    return result


def quats_from_vectors(vectors: FloatArray) -> FloatArray:
    """Return (n, 4) quaternions of (n, 3) rotation vectors: axis times angle, rad; NaN where not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        angle = np.linalg.norm(vectors, axis=1, keepdims=True)
        half = np.where(np.isfinite(angle), angle / 2.0, np.nan)
        return np.hstack([np.cos(half), vectors * (0.5 * np.sinc(half / np.pi))])


def rotate(quats: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return (n, 3): each vector turned by the unit quaternion in its row."""
    w, q = quats[:, :1], quats[:, 1:]
    with np.errstate(over="ignore", invalid="ignore"):
        twice = 2.0 * np.cross(q, vectors)
        result: FloatArray = vectors + w * twice + np.cross(q, twice)
    return result
