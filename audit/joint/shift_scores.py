"""`candidate_scores` of a principal point that most images of a model share, by passes over all observations.

A field of all images meets every column of the base, so that what is cheap image by image (`image_scores`) is not here;
but it has two columns only, and each is a few passes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.image_scores import sums_of_base
from sfm_audit.audit.joint.sums import moved_by
from sfm_audit.audit.joint.system import Base
from sfm_audit.audit.kernels.joint import JointSums
from sfm_audit.loaders.arrays import FloatArray, IntArray

_MIN_SHARE: Final = 0.25  # of the observations; below it, going through those of the images alone is cheaper


def shift_scores(base: Base, images: IntArray) -> CandidateScores | None:
    """Return the scores of (1, 0) and (0, 1) px on all observations of some images; None for the numpy path.

    Notes
    -----
    With O taking values off the points (v - J V^-1 J^T w v):  R = N^T w O E,  B = S^+ R,  K = E^T w O E - R^T B,
    u = E^T w y~,  G_t = sum over the views of a track of w y~^T (E - N B).
    """
    observations = base.observations
    num_own = int(np.diff(observations.offsets)[images].sum())
    if base.included or num_own < _MIN_SHARE * observations.source.size:
        return None
    sums = sums_of_base(base)
    if sums is None:
        return None
    shown = np.zeros(len(observations.offsets) - 1)
    shown[images] = 1.0
    on = np.repeat(shown, np.diff(observations.offsets))
    weight = observations.weight
    fields = [np.column_stack([on * (axis == 0), on * (axis == 1)]) for axis in range(2)]
    cleaned = [sums.off_points(field)[1] for field in fields]
    right = np.column_stack([_collected(base, sums, values) for values in cleaned])
    support = np.arange(observations.layout.num_columns, dtype=np.int64)
    solution = base.inverse.times(support, right)
    gram = np.array([[float((weight * on) @ cleaned[b][:, a]) for b in range(2)] for a in range(2)])
    gram -= right.T @ solution
    scores = (weight * on) @ base.left_px
    track_scores = np.column_stack([_by_point(base, sums, fields[axis], solution[:, axis]) for axis in range(2)])
    seen = np.zeros(observations.num_points, dtype=bool)
    seen[observations.point_idx[on > 0]] = True
    track_scores = track_scores[seen]
    sq_length = np.full(2, (weight * on).sum())
    meat = track_scores.T @ track_scores
    of_fields = sq_length, 0.5 * (gram + gram.T), scores, meat, len(track_scores)
    return CandidateScores(*of_fields, right, support, solution, num_own)


def _collected(base: Base, sums: JointSums, values_px: FloatArray) -> FloatArray:
    """(D,) N^T w values."""
    observations, layout = base.observations, base.observations.layout
    along = np.einsum("iab,ia->ib", observations.transform, sums.along_design(values_px))
    out = np.zeros(layout.num_columns + 1)
    np.add.at(out, layout.columns, along)
    return out[:-1]


def _by_point(base: Base, sums: JointSums, field_px: FloatArray, solution: FloatArray) -> FloatArray:
    """(P,) sum over the views of each point of w y~^T (E - N B)."""
    observations = base.observations
    left = field_px.copy()
    sums.subtract_step(moved_by(observations, solution), left)
    product = observations.weight * (base.left_px * left).sum(axis=1)
    return np.asarray(np.bincount(observations.point_idx, product, observations.num_points), dtype=np.float64)
