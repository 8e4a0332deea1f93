"""The poses of many images with few observations, profiled together: numpy's overhead is paid once, not per image."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.design import ImageDesign, OffPose, Piece, piece_of
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

Pieces = Callable[[int], Piece]


def in_windows(make: Callable[[range], Sequence[Piece]], num_images: int, size: int) -> Pieces:
    """Return images one by one, in ascending order, that are made ``size`` at a time."""
    window: dict[int, Piece] = {}

    def piece(i: int) -> Piece:
        if i not in window:
            window.clear()
            ahead = range(i, min(i + size, num_images))
            window.update(zip(ahead, make(ahead), strict=True))
        return window.pop(i)

    return piece


def pieces_of_joined(joined: ImageDesign, tracks: Sequence[IntArray]) -> list[Piece]:
    """Return `piece_of` of B images with equally many observations, to the last bit.

    Parameters
    ----------
    joined : (c, 2, B n) columns of one image after the other        tracks : (n,) of each
    """
    pose, intrinsics, fields = (
        _by_image(each, len(tracks)) for each in (joined.pose, joined.intrinsics, joined.fields)
    )
    residuals = joined.residuals_px.reshape(2, len(tracks), -1).transpose(1, 0, 2)
    known: dict[int, OffPose] = {}
    if fields.shape[1]:
        columns = np.concatenate([intrinsics, fields], axis=1)
        with np.errstate(all="ignore"):  # what is out of range is left to its image
            known = _off_poses(_flat(pose), _flat(columns), residuals.reshape(len(tracks), -1))
    return [
        Piece(track, intrinsics.shape[1], has_fields=True, part=known[b])
        if b in known
        else piece_of(ImageDesign(pose[b], intrinsics[b], fields[b], residuals[b], track))
        for b, track in enumerate(tracks)
    ]


def _off_poses(pose: FloatArray, columns: FloatArray, y: FloatArray) -> dict[int, OffPose]:
    """Return the images whose pose has full rank beyond doubt and whose columns are in range."""
    squares = np.einsum("bcm,bcm->bc", pose, pose)
    usual = np.flatnonzero(_within(squares) & _within(np.einsum("bcm,bcm->bc", columns, columns)))
    unit = pose[usual] / np.sqrt(squares[usual])[:, :, None]
    values, vectors = np.linalg.eigh(unit @ unit.swapaxes(1, 2))
    sure = values[:, 0] > basis.SMALLEST_PIVOT * values[:, -1]
    chosen = usual[sure].astype(np.int64)
    q = _times(vectors[sure], values[sure], unit[sure])
    values, vectors = np.linalg.eigh(q @ q.swapaxes(1, 2))  # again: orthonormal to rounding
    q = _times(vectors, values, q)
    leverage = np.einsum("bqm,bqm->bm", q, q)
    finite: BoolArray = np.ones(columns.shape[1], dtype=np.bool_)
    out = {}
    for own, b in enumerate(chosen.tolist()):
        coordinates = basis.project_off_in_place(q[own], columns[b])
        basis.project_off_in_place(q[own], columns[b])
        out[b] = OffPose(columns[b], coordinates, basis.project_off(q[own], y[b]), leverage[own], finite)
    return out


def _by_image(columns: FloatArray, num_images: int) -> FloatArray:
    """(B, c, 2, n) of (c, 2, B n)."""
    num_points = columns.shape[2] // num_images  # of no columns too
    by_column = columns.reshape(len(columns), 2, num_images, num_points)
    return np.ascontiguousarray(by_column.transpose(2, 0, 1, 3))


def _flat(columns: FloatArray) -> FloatArray:
    """(B, c, 2 n) of (B, c, 2, n)."""
    return columns.reshape(*columns.shape[:2], 2 * columns.shape[3])


def _within(squares: FloatArray) -> BoolArray:
    """(B,) whether all (B, c) are in the range in which no sum of squares loses anything."""
    return np.asarray(((squares > basis.SAFE_SQUARE) & (squares < 1.0 / basis.SAFE_SQUARE)).all(axis=1))


def _times(vectors: FloatArray, values: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray((vectors / np.sqrt(values)[:, None]).swapaxes(1, 2) @ columns)
