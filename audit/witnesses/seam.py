"""The two sides of a seam: images whose pairs contradict the model."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_MAX_TURNS: Final = 1000


def seam_of(image_idx: IntArray, against: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the images on either side, those with most contradicted pairs first.

    Parameters
    ----------
    image_idx : (k, 2) images of the strong pairs        against : (k,) which of them contradict the model

    Notes
    -----
    A local optimum of the signed cut: contradicted pairs should join different sides, satisfied pairs the same one.
    Only images with a contradicted pair take part. Starts from the image with most of them; deterministic.
    """
    members, inverse = np.unique(image_idx[against], return_inverse=True)
    if not len(members):
        return members, members
    num_against = np.bincount(inverse.ravel(), minlength=len(members))
    inside = np.isin(image_idx, members).all(axis=1)
    ends = np.searchsorted(members, image_idx[inside])
    weight = np.where(against[inside], -1.0, 1.0)
    side = _placed(ends, weight, int(np.argmax(num_against)), len(members))
    for _ in range(_MAX_TURNS):
        pull = _pull(ends, weight, side)
        worst = int(np.argmin(pull * side))
        if not pull[worst] * side[worst] < 0:
            break
        side[worst] = -side[worst]
    order = np.argsort(-num_against, kind="stable")
    return members[order][side[order] >= 0], members[order][side[order] < 0]


def _placed(ends: IntArray, weight: FloatArray, seed: int, num: int) -> FloatArray:
    """Give every image a side, from the seed outward; parts of the graph that it does not reach start anew."""
    side = np.zeros(num)
    side[seed] = 1.0
    while (unplaced := side == 0).any():
        found = np.sign(_pull(ends, weight, side)) * unplaced
        if not found.any():
            found[np.flatnonzero(unplaced)[0]] = 1.0
        side += found
    return side


def _pull(ends: IntArray, weight: FloatArray, side: FloatArray) -> FloatArray:
    """Return to which side its pairs draw each image."""
    num = len(side)
    first = np.bincount(ends[:, 0], weight * side[ends[:, 1]], minlength=num)
    return np.asarray(first + np.bincount(ends[:, 1], weight * side[ends[:, 0]], minlength=num))
