"""Which similarity takes one set of poses to another, where part of the images may have moved? Seeded LO-RANSAC.

A hypothesis takes two images: the first one's rotations give the rotation, both centres scale and shift. The support
is a truncated sum of squares of the errors of centres and rotations (MSAC). The best hypotheses are refined on what
supports them (local optimisation) by a Procrustes fit to centres and camera axes together, so that it is defined for
cameras on a line too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.alignment.poses import Poses
from sfm_audit.loaders.arrays import BoolArray, FloatArray

CENTRE_TOLERANCE: Final = 0.05
"""Centres that agree within so many units follow the same similarity ..."""
ROTATION_TOLERANCE_DEG: Final = 2.0
"""... if their rotations agree within so many degrees (both together: the squares of the shares add up to 1)."""
MIN_SUPPORT: Final = 3
_NUM_HYPOTHESES: Final = 400
_NUM_REFINED: Final = 8
_MAX_REFINEMENTS: Final = 10


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x -> scale rotation x + shift, from the world of the first set of poses to that of the second."""

    scale: float
    rotation: FloatArray
    shift: FloatArray

    def points(self, xyz: FloatArray) -> FloatArray:
        """Move points (n, 3)."""
        moved: FloatArray = self.scale * xyz @ self.rotation.T + self.shift
        return moved

    def back(self, xyz: FloatArray) -> FloatArray:
        """Move points (n, 3) of the second world to the first."""
        moved: FloatArray = (xyz - self.shift) @ self.rotation / self.scale
        return moved


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A similarity, and per image the error that it leaves.

    centre: (n, 3) second centre, moved to the first world, minus the first one, in units.
    rotation_deg: (n,) angle between the rotations after the alignment.    supports: (n,) follow the similarity.
    """

    similarity: Similarity
    centre: FloatArray
    rotation_deg: FloatArray

    @property
    def tolerances(self) -> FloatArray:
        """(n,) error of centre and rotation together, in tolerances."""
        return np.sqrt(_cost(self.centre, self.rotation_deg))

    @property
    def supports(self) -> BoolArray:
        """(n,) which images follow it."""
        supports: BoolArray = self.tolerances < 1
        return supports


def align(before: Poses, after: Poses, unit: float, *, seed: int = 0) -> Alignment | None:
    """Find the similarity that most images follow.

    Parameters
    ----------
    before, after : the same n images in the same order
    unit : the unit of lengths, in model units of ``before``
    seed : of the hypotheses; the same poses and seed give the same alignment

    Returns
    -------
    Alignment
        None with fewer than 3 images, or where no 3 follow the same similarity (all centres in one place, too).
    """
    if len(before) < MIN_SUPPORT or not unit > 0:
        return None
    turns = np.einsum("nki,nkj->nij", after.rotation, before.rotation)  # second world from first, as each image has it
    pairs = _pairs(len(before), np.random.default_rng(seed))
    hypotheses = _hypotheses(before, after, turns, pairs)
    if not len(hypotheses):
        return None
    costs = np.array([_support(h, before, after, turns, unit) for h in hypotheses])
    best: tuple[float, Similarity] | None = None
    for k in np.argsort(costs, kind="stable")[:_NUM_REFINED]:
        found = _refined(hypotheses[int(k)], before, after, turns, unit)
        if best is None or found[0] < best[0]:
            best = found
    if best is None:
        return None
    out = _alignment(best[1], before, after, turns, unit)
    return out if np.count_nonzero(out.supports) >= MIN_SUPPORT else None


def _pairs(n: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Ordered pairs of images: all of them where they are few."""
    if n * (n - 1) <= _NUM_HYPOTHESES:
        return [(i, j) for i in range(n) for j in range(n) if i != j]
    first, step = rng.integers(0, n, _NUM_HYPOTHESES), rng.integers(1, n, _NUM_HYPOTHESES)
    return [(int(i), int((i + k) % n)) for i, k in zip(first, step, strict=True)]


def _hypotheses(before: Poses, after: Poses, turns: FloatArray, pairs: list[tuple[int, int]]) -> list[Similarity]:
    out = []
    for i, j in pairs:
        length = float(np.linalg.norm(before.centre[j] - before.centre[i]))
        other = float(np.linalg.norm(after.centre[j] - after.centre[i]))
        if length > 0 and other > 0 and np.isfinite(other / length):
            scale = other / length
            out.append(Similarity(scale, turns[i], after.centre[i] - scale * turns[i] @ before.centre[i]))
    return out


def _support(similarity: Similarity, before: Poses, after: Poses, turns: FloatArray, unit: float) -> float:
    found = _alignment(similarity, before, after, turns, unit)
    return float(np.minimum(_cost(found.centre, found.rotation_deg), 1.0).sum())


def _cost(centre: FloatArray, rotation_deg: FloatArray) -> FloatArray:
    cost: FloatArray = (centre**2).sum(axis=1) / CENTRE_TOLERANCE**2 + (rotation_deg / ROTATION_TOLERANCE_DEG) ** 2
    return cost


def _alignment(similarity: Similarity, before: Poses, after: Poses, turns: FloatArray, unit: float) -> Alignment:
    centre = (similarity.back(after.centre) - before.centre) / unit
    return Alignment(similarity, centre, angle_deg(np.einsum("ij,njk->nik", similarity.rotation.T, turns)))


def angle_deg(rotation: FloatArray) -> FloatArray:
    """Return the angles of rotations (..., 3, 3), degrees; exact for small ones too."""
    skew = np.stack([rotation[..., 2, 1], rotation[..., 0, 2], rotation[..., 1, 0]], axis=-1) - np.stack(
        [rotation[..., 1, 2], rotation[..., 2, 0], rotation[..., 0, 1]], axis=-1
    )
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    angle: FloatArray = np.degrees(np.arctan2(np.linalg.norm(skew, axis=-1), trace - 1.0))
    return angle


def _refined(
    start: Similarity, before: Poses, after: Poses, turns: FloatArray, unit: float
) -> tuple[float, Similarity]:
    """Fit to what supports the similarity, as long as that gets better."""
    best = _support(start, before, after, turns, unit), start
    for _ in range(_MAX_REFINEMENTS):
        inside = _alignment(best[1], before, after, turns, unit).supports
        if np.count_nonzero(inside) < MIN_SUPPORT:
            break
        fitted = _fit(before.take(inside), after.take(inside), turns[inside], unit)
        if fitted is None:
            break
        cost = _support(fitted, before, after, turns, unit)
        if cost >= best[0]:
            break
        best = cost, fitted
    return best


def _fit(before: Poses, after: Poses, turns: FloatArray, unit: float) -> Similarity | None:
    """Least squares of centres, and of camera axes of one unit's length, weighed alike."""
    middle, other = before.centre.mean(axis=0), after.centre.mean(axis=0)
    x, y = before.centre - middle, after.centre - other
    spread = float((x**2).sum())
    if spread <= 0:
        return None
    guess = float(np.sqrt((y**2).sum() / spread))  # of the scale, for the units of y alone
    if guess <= 0:
        return None
    u, _, vt = np.linalg.svd(y.T @ x / (guess * unit**2) + turns.sum(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = float((y * (x @ rotation.T)).sum() / spread)
    return Similarity(scale, rotation, other - scale * rotation @ middle) if scale > 0 else None
