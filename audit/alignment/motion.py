"""Who moved between two sets of poses: fragments, single images, and a smooth bending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.alignment.poses import Poses
from sfm_audit.audit.alignment.similarity import (
    CENTRE_TOLERANCE,
    MIN_SUPPORT,
    ROTATION_TOLERANCE_DEG,
    Alignment,
    align,
    angle_deg,
)
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

MAX_FRAGMENTS: Final = 32
APART: Final = 2.0
"""Tolerances that half of a fragment's images are off: less, and any three noisy images make one by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Fragment:
    """Images that moved together against the main group.

    image_idxs: rows, ascending.    turn_deg: rotation against the main group.
    shift: median distance that its cameras moved, in units.    stretch: its scale / that of the main group.
    """

    image_idxs: IntArray
    turn_deg: float
    shift: float
    stretch: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseComparison:
    """Two sets of poses of the same images, aligned.

    centre_error: (n,) units.    rotation_deg: (n,).    main: (n,) follow the main group, bent or not.
    fragments: those that moved together, torn off at one end at least, largest first.
    bending: RMS of the part of the centres' errors that neighbours in the order of the images share, units.
    """

    alignment: Alignment
    centre_error: FloatArray
    rotation_deg: FloatArray
    main: BoolArray
    fragments: tuple[Fragment, ...]
    bending: float

    @property
    def moved(self) -> BoolArray:
        """(n,) which images are elsewhere, with a fragment or alone."""
        return ~self.main


def compare_poses(before: Poses, after: Poses, unit: float, *, seed: int = 0) -> PoseComparison | None:
    """Align two sets of poses and say who moved.

    Parameters
    ----------
    before, after : the same n images in the same order, which is the order in which they were taken as far as known
    unit : of lengths, in model units of ``before``          seed : see `align`

    Returns
    -------
    PoseComparison
        None where nothing can be aligned.

    Notes
    -----
    What does not follow the main similarity is aligned again by itself, and so on: groups of 3 images and more. A group
    of which no image jumps against its neighbours in the order (by less than the tolerances of `align`) is a bent
    part of the main group; a group with a jump, and clearly elsewhere, is a fragment.
    """
    main = align(before, after, unit, seed=seed)
    if main is None:
        return None
    groups = _groups(before, after, unit, main, seed)
    label = np.full(len(before), -1)
    label[main.supports] = 0
    for k, (idxs, _) in enumerate(groups, 1):
        label[idxs] = k
    turned = _turns_against(main, before, after)
    bent = _bent(label, main.centre, turned)
    follows = np.isin(label, [0, *bent])
    fragments = [
        _fragment(idxs, found, main)
        for k, (idxs, found) in enumerate(groups, 1)
        if k not in bent and np.median(main.tolerances[idxs]) > APART
    ]
    return PoseComparison(
        main,
        np.linalg.norm(main.centre, axis=1),
        main.rotation_deg,
        follows,
        tuple(sorted(fragments, key=lambda one: -len(one.image_idxs))),
        _bending(main.centre[follows]),
    )


def _groups(before: Poses, after: Poses, unit: float, main: Alignment, seed: int) -> list[tuple[IntArray, Alignment]]:
    """Return rows and alignment of every further group."""
    left = np.flatnonzero(~main.supports)
    out: list[tuple[IntArray, Alignment]] = []
    while len(left) >= MIN_SUPPORT and len(out) < MAX_FRAGMENTS:
        found = align(before.take(left), after.take(left), unit, seed=seed)
        if found is None:
            break
        out.append((left[found.supports], found))
        left = left[~found.supports]
    return out


def _turns_against(main: Alignment, before: Poses, after: Poses) -> FloatArray:
    """Return (n, 3, 3): what is left of each image's turn after the alignment, in the first world."""
    turned: FloatArray = np.einsum("ji,nkj,nkl->nil", main.similarity.rotation, after.rotation, before.rotation)
    return turned


def _bent(label: IntArray, centre: FloatArray, turned: FloatArray) -> set[int]:
    """Return the groups that hang on the main one without a jump, directly or through each other.

    label: (n,) 0 main, 1.. groups, -1 alone.    centre: (n, 3) errors, units.    turned: (n, 3, 3) errors.
    """
    step = np.linalg.norm(np.diff(centre, axis=0), axis=1) / CENTRE_TOLERANCE
    angle = angle_deg(np.einsum("nji,njk->nik", turned[:-1], turned[1:])) / ROTATION_TOLERANCE_DEG
    seams = [
        (int(a), int(b), bool(smooth))
        for a, b, smooth in zip(label[:-1], label[1:], step**2 + angle**2 < 1, strict=True)
        if a != b and min(a, b) >= 0
    ]
    torn = {k for a, b, smooth in seams if not smooth for k in (a, b) if k > 0}
    bent: set[int] = set()
    for _ in range(len(seams)):
        near = {b if a in bent | {0} else a for a, b, smooth in seams if smooth and {a, b} & (bent | {0})}
        more = near - torn - bent - {0}
        if not more:
            break
        bent |= more
    return bent


def _fragment(idxs: IntArray, found: Alignment, main: Alignment) -> Fragment:
    turn = angle_deg(main.similarity.rotation.T @ found.similarity.rotation)
    shift = np.median(np.linalg.norm(main.centre[idxs], axis=1))
    return Fragment(idxs, float(turn), float(shift), found.similarity.scale / main.similarity.scale)


def _bending(centre: FloatArray) -> float:
    """RMS of what neighbours share (von Neumann's ratio): 0 for errors that are independent of each other."""
    if len(centre) < MIN_SUPPORT:
        return 0.0
    centred = centre - centre.mean(axis=0)
    total = float((centred**2).sum())
    if total <= 0:
        return 0.0
    shared = 1.0 - float((np.diff(centred, axis=0) ** 2).sum()) / (2.0 * total)
    return float(np.sqrt(max(shared, 0.0) * total / len(centre)))
