"""What would candidate fields of some images take up that nothing in the base can? (method.md (7), never over all)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from audit.joint.neighbourhood import Neighbourhood, neighbourhood, point_chunks, sum_by_track
from audit.joint.system import Base, IncludedFields
from loaders.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class CandidateScores:
    """c candidate fields, projected off the base: sums that need nobody beyond who shares their tracks.

    sq_length: (c,) |E|^2 before the projection.    gram: (c, c) K.    score: (c,) u.
    track_score: (T, c) G of the T tracks that the images see.
    coupling: (s, c) R at the columns ``support`` (s,) of the base.    solution: (s, c) B = S^+ R there.
    num_observations: of the images.
    """

    sq_length: FloatArray
    gram: FloatArray
    score: FloatArray
    track_score: FloatArray
    coupling: FloatArray
    support: IntArray
    solution: FloatArray
    num_observations: int


def candidate_scores(base: Base, fields: Mapping[int, FloatArray]) -> CandidateScores:
    """Project candidate fields off the base and correlate them with what it leaves.

    Parameters
    ----------
    fields : per image (n_i, 2, c) px per unit, of all its observations; column j is one unknown for all images

    Notes
    -----
    y~ is orthogonal to J track by track and to N as a whole, so E~ itself is not needed:
    R = N^T E - W V^-1 J^T E,  B = S^+ R,  K = E^T E - (J^T E)^T V^-1 (J^T E) - R^T B,  u = E^T y~,
    G_t = sum over own views of E^T y~ - sum over all views k of the track of B_k^T N_k^T y~_k.
    """
    observations = base.observations
    images = sorted(fields)
    rows = np.concatenate([np.arange(*observations.offsets[image : image + 2]) for image in images])
    own = np.concatenate([fields[image] for image in images])
    count = own.shape[2]
    weighted = own * observations.weight[rows, None, None]
    gram = weighted.reshape(-1, count).T @ own.reshape(-1, count)
    sq_length = gram.diagonal().copy()
    points, track = np.unique(observations.point_idx[rows], return_inverse=True)
    jacobian = np.concatenate([observations.jacobian(image) for image in images])
    crossed = sum_by_track(jacobian.transpose(0, 2, 1) @ weighted, track, points.size)  # J^T E
    absorbed = base.point_inverse[points] @ crossed
    gram -= crossed.reshape(-1, count).T @ absorbed.reshape(-1, count)
    coupling = _own_coupling(base, images, weighted)
    chunks = [neighbourhood(observations, points[part]) for part in point_chunks(observations, points)]
    parts = list(point_chunks(observations, points))
    if not observations.points_independent:
        for around, part in zip(chunks, parts, strict=True):
            _couple_tracks(base, around, absorbed[part], coupling)
    support = np.flatnonzero((coupling[:-1] != 0).any(axis=1))
    coupling = coupling[support]
    solution = base.inverse.block(support) @ coupling
    gram -= coupling.T @ solution
    track_score = np.einsum("nac,na->nc", weighted, base.left_px[rows])
    score = track_score.sum(axis=0)
    track_score = sum_by_track(track_score, track, points.size)
    everywhere = np.zeros((base.inverse.size + 1, count))
    everywhere[support] = solution
    for around, part in zip(chunks, parts, strict=True):
        track_score[part] -= _base_scores(base, around, everywhere)
    return CandidateScores(
        sq_length, 0.5 * (gram + gram.T), score, track_score, coupling, support, solution, rows.size
    )


def _own_coupling(base: Base, images: list[int], weighted: FloatArray) -> FloatArray:
    """N^T E (D + m + 1, c), included fields among N; the last row is padding."""
    observations = base.observations
    layout = observations.layout
    out = np.zeros((base.inverse.size + 1, weighted.shape[2]))
    columns = _padded(base, layout.columns)
    start = 0
    for image in images:
        stop = start + observations.num_of(image)
        own = observations.nuisance(image).reshape(-1, layout.width)
        part = weighted[start:stop].reshape(own.shape[0], -1)
        np.add.at(out, columns[image], own.T @ part)
        extra = base.included.get(image)
        if extra is not None:
            out[extra.columns] += extra.fields.reshape(own.shape[0], -1).T @ part
        start = stop
    return out


def _padded(base: Base, columns: IntArray) -> IntArray:
    """Columns with padding moved behind those of included fields."""
    return np.where(columns < base.observations.layout.num_columns, columns, base.inverse.size)


def _couple_tracks(base: Base, around: Neighbourhood, absorbed: FloatArray, coupling: FloatArray) -> None:
    """Subtract W V^-1 J^T E in place."""
    shared = around.gather(base.observations.crossed[around.views], absorbed)
    np.subtract.at(coupling, _padded(base, base.observations.layout.columns[around.images]), shared)
    for extra, own, within in _included_near(base, around):
        seen = absorbed[around.track[own]].reshape(-1, absorbed.shape[2])
        coupling[extra.columns] -= extra.crossed[within].transpose(1, 0, 2).reshape(extra.columns.size, -1) @ seen


def _base_scores(base: Base, around: Neighbourhood, everywhere: FloatArray) -> FloatArray:
    """(T, c) sum over the views of each track of B_k^T h_k; ``everywhere`` (D + m + 1, c) is B, its last row zero."""
    observations = base.observations
    columns = _padded(base, observations.layout.columns[around.images])
    out = around.scatter(base.view_scores[around.by_track], everywhere[columns])
    for extra, own, within in _included_near(base, around):
        views = around.views[own]
        left = base.left_px[views] * observations.weight[views, None]
        score = np.einsum("nar,na->nr", extra.fields[within], left)
        np.add.at(out, around.track[own], score @ everywhere[extra.columns])
    return out


def _included_near(base: Base, around: Neighbourhood) -> list[tuple[IncludedFields, slice, IntArray]]:
    """Included fields of the images around, with their views and where these are among the image's observations."""
    if not base.included:
        return []
    return [
        (base.included[image], own, around.views[own] - int(base.observations.offsets[image]))
        for image, own in around.segments()
        if image in base.included
    ]
