"""Fields of single images become free parameters of the base: the inverse grows a border (method.md 11b)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.joint.candidates import FieldsInParts, FieldsMet, ImageFields
from sfm_audit.audit.joint.group_test import KEPT_EIGENVALUE, group_root
from sfm_audit.audit.joint.inverse import DenseInverse, JointInverse
from sfm_audit.audit.joint.neighbourhood import sum_by_track
from sfm_audit.audit.joint.sums import joint_sums, moved_by
from sfm_audit.audit.joint.system import Base, IncludedFields, with_step
from sfm_audit.audit.kernels.joint_inclusion import take_change
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, distinct

_COLUMNS_AT_ONCE: Final = 300


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Fields of one image that are to be free.

    fields: (n_i, 2, c) px per unit.    nuisance: gives (n, 2, C) px per unit, nuisance columns of chosen observations.
    """

    image_idx: int
    fields: FloatArray
    nuisance: Callable[[slice | IntArray], FloatArray]

    def part(self, chosen: slice | IntArray) -> ImageFields:
        """Return fields and nuisance columns of some of the observations."""
        return ImageFields(self.fields[chosen], self.nuisance(chosen))


class _New(NamedTuple):
    """Fields (n_i, 2, r) of one image with K = 1, what they meet, and (D + m, r) B = S^+ R.    gram: (r, r) K.

    right: (s, r) R at ``support``.
    """

    image_idx: int
    fields: FloatArray
    gram: FloatArray
    score: FloatArray
    support: IntArray
    right: FloatArray
    solution: FloatArray


def include(base: Base, candidates: list[Candidate]) -> Base:
    """Return the base with the candidates' fields free, all at once.

    Notes
    -----
    theta = K^+ u with K of all new fields together (those of two images meet in shared points), step -> step - B
    theta, and the inverse gets a border. Directions of K with unit columns below 1e-4 stay out, as in the test.
    """
    met = [FieldsMet(base, [each.image_idx], _in_parts(each)) for each in candidates]
    solved = zip(candidates, met, _solutions(base.inverse, met), strict=True)
    new = [_independent(*each) for each in solved]
    starts = np.cumsum([0, *(own.gram.shape[0] for own in new)])
    size = base.inverse.size
    solution = np.concatenate([own.solution for own in new], axis=1)
    root = _inverse_root(_joint_gram(base, new, starts, solution))
    theta = root @ (root.T @ np.concatenate([own.score for own in new]))
    step = np.concatenate([base.step - solution @ theta, theta])
    included = dict(base.included)
    for k, own in enumerate(new):
        columns = size + np.arange(starts[k], starts[k + 1])
        included[own.image_idx] = IncludedFields(own.image_idx, own.fields, columns)
    grown = replace(base, inverse=base.inverse.bordered(solution, root), included=included)
    return _with_change(base, grown, step)


def _with_change(base: Base, grown: Base, step: FloatArray) -> Base:
    """Return the grown base with another step than ``base`` had; only what changes is projected."""
    observations = base.observations
    sums = joint_sums(observations, base.left_px, observations.weight, base.point_inverse)
    if sums is None:
        return with_step(grown, step)
    change = step.copy()
    change[: base.step.size] -= base.step
    fields = {image: extra.fields @ change[extra.columns] for image, extra in grown.included.items()}
    found = take_change(sums, moved_by(observations, change), fields, base.point_step)
    return with_step(grown, step) if found is None else replace(grown, step=step, point_step=found[0], left_px=found[1])


def _in_parts(candidate: Candidate) -> Callable[[int], FieldsInParts]:
    return lambda _: FieldsInParts(candidate.part)


def _solutions(inverse: JointInverse, met: list[FieldsMet]) -> Iterator[FloatArray]:
    """(D + m, c) S^+ R of each image's fields; those of several are solved for together where S^+ is a band."""
    batch: list[FieldsMet] = []
    for k, own in enumerate(met):
        batch.append(own)
        num = sum(each.right.shape[1] for each in batch)
        if k + 1 < len(met) and num < _COLUMNS_AT_ONCE and not isinstance(inverse.main, DenseInverse):
            continue
        support = distinct(np.concatenate([each.support for each in batch]))
        right, start = np.zeros((support.size, num)), 0
        for each in batch:
            stop = start + each.right.shape[1]
            right[np.searchsorted(support, each.support), start:stop] = each.right
            start = stop
        solution = inverse.times(support, right)
        yield from np.split(solution, np.cumsum([each.right.shape[1] for each in batch])[:-1], axis=1)
        batch = []


def _independent(candidate: Candidate, met: FieldsMet, solution: FloatArray) -> _New:
    """The directions of a candidate's fields that the base leaves, in units in which K = 1."""
    scores = met.scores(solution[met.support], np.full(met.gram.shape, np.nan))
    root = group_root(scores, slice(0, candidate.fields.shape[2]))
    gram = root @ scores.gram @ root.T
    turned = (each @ root.T for each in (scores.coupling, solution))
    return _New(candidate.image_idx, candidate.fields @ root.T, gram, root @ scores.score, scores.support, *turned)


def _joint_gram(base: Base, new: list[_New], starts: IntArray, solution: FloatArray) -> FloatArray:
    """K (k, k) of all new fields: - (J^T E)^T V^-1 (J^T E) - R^T B between images, the tests' own K within."""
    out = np.zeros((int(starts[-1]),) * 2)
    places = [slice(int(first), int(last)) for first, last in pairwise(starts)]
    for place, own in zip(places, new, strict=True):
        out[place] = -own.right.T @ solution[own.support]
    at_shared = [_at_shared_points(base, own, shared) for shared in [_shared_points(base, new)] for own in new]
    for i, (points, crossed) in enumerate(at_shared):
        for k in range(i + 1, len(new)):
            others, other = at_shared[k]
            if not (points.size and others.size and points[0] <= others[-1] and others[0] <= points[-1]):
                continue
            _, mine, theirs = np.intersect1d(points, others, assume_unique=True, return_indices=True)
            absorbed = base.point_inverse[points[mine]] @ crossed[mine]
            met = absorbed.reshape(-1, absorbed.shape[2]).T @ other[theirs].reshape(-1, other.shape[2])
            out[places[i], places[k]] -= met
            out[places[k], places[i]] -= met.T
    for place, own in zip(places, new, strict=True):
        out[place, place] = own.gram
    return 0.5 * (out + out.T)


def _shared_points(base: Base, new: list[_New]) -> BoolArray:
    """(P,) points that several of the images show."""
    observations = base.observations
    count = np.zeros(observations.num_points, dtype=np.int64)
    for own in new:
        count[distinct(observations.point_idx[observations.rows(own.image_idx)])] += 1
    return count > 1


def _at_shared_points(base: Base, own: _New, shared: BoolArray) -> tuple[IntArray, FloatArray]:
    """Those points that an image shows (t,), and (t, 3, r) J^T w E of each."""
    observations = base.observations
    rows = observations.rows(own.image_idx)
    chosen = np.flatnonzero(shared[observations.point_idx[rows]])
    points, place = np.unique(observations.point_idx[rows][chosen].astype(np.int64), return_inverse=True)
    weighted = own.fields[chosen] * observations.weight[rows][chosen, None, None]
    crossed = observations.jacobian(own.image_idx, chosen).transpose(0, 2, 1) @ weighted
    return points, sum_by_track(crossed, place, points.size)


def _inverse_root(schur: FloatArray) -> FloatArray:
    """Root of K^+ off eigenvalues of the unit columns below 1e-4."""
    scale = 1.0 / np.sqrt(schur.diagonal())
    values, vectors = np.linalg.eigh(schur * scale * scale[:, None])
    kept = values > KEPT_EIGENVALUE
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]))
