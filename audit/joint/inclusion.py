"""Fields of single images become free parameters of the base: the inverse grows a border (method.md 11b)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from sfm_audit.audit.joint.candidates import CandidateScores, FieldsInParts, ImageFields, candidate_scores
from sfm_audit.audit.joint.group_test import KEPT_EIGENVALUE
from sfm_audit.audit.joint.system import Base, IncludedFields, with_step
from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Fields of one image that are to be free.

    fields: (n_i, 2, r) px per unit.    nuisance: gives (n, 2, C) px per unit, nuisance columns of chosen observations.
    """

    image_idx: int
    fields: FloatArray
    nuisance: Callable[[slice | IntArray], FloatArray]

    def part(self, chosen: slice | IntArray) -> ImageFields:
        """Return fields and nuisance columns of some of the observations."""
        return ImageFields(self.fields[chosen], self.nuisance(chosen))


def include(base: Base, candidates: list[Candidate]) -> Base:
    """Return the base with the candidates' fields free, all at once.

    Notes
    -----
    theta = K^+ u with K of all new fields together (those of two images meet in shared points), step -> step - B
    theta, and the inverse gets a border. Directions of K with unit columns below 1e-4 stay out, as in the test.
    """
    by_image = {c.image_idx: FieldsInParts(c.part) for c in candidates}
    scores = [candidate_scores(base, [c.image_idx], by_image.__getitem__) for c in candidates]
    starts = np.cumsum([0, *(c.fields.shape[2] for c in candidates)])
    size = base.inverse.size
    solution = np.empty((size, int(starts[-1])))
    for k, own in enumerate(scores):
        solution[:, starts[k] : starts[k + 1]] = base.inverse.times(own.support, own.coupling)
    schur = _joint_gram(base, candidates, scores, starts, solution)
    root = _inverse_root(schur)
    theta = root @ (root.T @ np.concatenate([own.score for own in scores]))
    step = np.concatenate([base.step - solution @ theta, theta])
    included = dict(base.included)
    for k, candidate in enumerate(candidates):
        columns = size + np.arange(starts[k], starts[k + 1])
        included[candidate.image_idx] = IncludedFields(candidate.image_idx, candidate.fields, columns)
    grown = replace(base, inverse=base.inverse.bordered(solution, root), included=included)
    return with_step(grown, step)


def _joint_gram(
    base: Base,
    candidates: list[Candidate],
    scores: list[CandidateScores],
    starts: FloatArray,
    solution: FloatArray,
) -> FloatArray:
    """K (k, k) of all new fields: - (J^T E)^T V^-1 (J^T E) - R^T B between images, the tests' own K within."""
    if len(candidates) == 1:
        return 0.5 * (scores[0].gram + scores[0].gram.T)
    observations = base.observations
    total = int(starts[-1])
    coupled = np.zeros((base.inverse.size, total))
    parts = []
    for k, (candidate, own) in enumerate(zip(candidates, scores, strict=True)):
        columns = slice(int(starts[k]), int(starts[k + 1]))
        coupled[own.support, columns] = own.coupling
        rows = observations.rows(candidate.image_idx)
        weighted = candidate.fields * observations.weight[rows, None, None]
        crossed = observations.jacobian(candidate.image_idx).transpose(0, 2, 1) @ weighted
        shape = (3 * observations.num_points, columns.stop - columns.start)
        row = 3 * observations.point_idx[rows][:, None, None] + np.arange(3)[:, None] + np.zeros(shape[1], dtype=int)
        column = np.broadcast_to(np.arange(shape[1]), crossed.shape)
        parts.append(sparse.coo_array((crossed.ravel(), (row.ravel(), column.ravel())), shape=shape).tocsc())
    out = -coupled.T @ solution
    crossed_all = sparse.hstack(parts).tocsr()
    seen = distinct(crossed_all.nonzero()[0] // 3)
    inverse = sparse.bsr_array(
        (base.point_inverse[seen], seen, np.searchsorted(seen, np.arange(observations.num_points + 1))),
        shape=(3 * observations.num_points,) * 2,
    )
    out -= (crossed_all.T @ (inverse.tocsr() @ crossed_all)).toarray()
    for k, own in enumerate(scores):
        columns = slice(int(starts[k]), int(starts[k + 1]))
        out[columns, columns] = own.gram
    return 0.5 * (out + out.T)


def _inverse_root(schur: FloatArray) -> FloatArray:
    """Root of K^+ off eigenvalues of the unit columns below 1e-4."""
    scale = 1.0 / np.sqrt(schur.diagonal())
    values, vectors = np.linalg.eigh(schur * scale * scale[:, None])
    kept = values > KEPT_EIGENVALUE
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]))
