"""The poses of many images with few observations, profiled together: numpy's overhead is paid once, not per image."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sfm_audit.audit.inliers.joined import by_image, flat
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
    pose, intrinsics, fields = (by_image(each, len(tracks)) for each in (joined.pose, joined.intrinsics, joined.fields))
    residuals = joined.residuals_px.reshape(2, len(tracks), -1).transpose(1, 0, 2)
    known: dict[int, OffPose] = {}
    if fields.shape[1]:
        columns = np.concatenate([intrinsics, fields], axis=1)
        with np.errstate(all="ignore"):  # what is out of range is left to its image
            known = _off_poses(flat(pose), flat(columns), residuals.reshape(len(tracks), -1))
    return [
        Piece(track, intrinsics.shape[1], has_fields=True, part=known[b])
        if b in known
        else piece_of(ImageDesign(pose[b], intrinsics[b], fields[b], residuals[b], track))
        for b, track in enumerate(tracks)
    ]


def _off_poses(pose: FloatArray, columns: FloatArray, y: FloatArray) -> dict[int, OffPose]:
    """Return the images whose pose has full rank beyond doubt and whose columns are in range."""
    usual = basis.in_range(np.einsum("bcm,bcm->bc", columns, columns))
    chosen, q = basis.nuisance_bases(pose)
    chosen, q = chosen[usual[chosen]], q[usual[chosen]]
    leverage = np.einsum("bqm,bqm->bm", q, q)
    finite: BoolArray = np.ones(columns.shape[1], dtype=np.bool_)
    out = {}
    for own, b in enumerate(chosen.tolist()):
        coordinates = basis.project_off_in_place(q[own], columns[b])
        basis.project_off_in_place(q[own], columns[b])
        out[b] = OffPose(columns[b], coordinates, basis.project_off(q[own], y[b]), leverage[own], finite)
    return out
