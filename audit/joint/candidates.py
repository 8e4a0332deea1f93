"""What would candidate fields of some images take up that nothing in the base can? (method.md (7), never over all)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

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


class ImageFields(NamedTuple):
    """Candidate fields (n_i, 2, c) px per unit of one image beside its nuisance columns (n_i, 2, C)."""

    fields: FloatArray
    nuisance: FloatArray


def candidate_scores(base: Base, fields: Mapping[int, ImageFields]) -> CandidateScores:
    """Project candidate fields off the base and correlate them with what it leaves.

    Parameters
    ----------
    fields : per image, of all its observations; column j is one unknown for all images

    Notes
    -----
    y~ is orthogonal to J track by track and to N as a whole, so E~ itself is not needed:
    R = N^T E - W V^-1 J^T E,  B = S^+ R,  K = E^T E - (J^T E)^T V^-1 (J^T E) - R^T B,  u = E^T y~,
    G_t = sum over own views of E^T y~ - sum over all views k of the track of B_k^T N_k^T y~_k.
    """
    observations = base.observations
    images = sorted(fields)
    rows = np.concatenate([np.arange(*observations.offsets[image : image + 2]) for image in images])
    own = np.concatenate([fields[image].fields for image in images]) if len(images) > 1 else fields[images[0]].fields
    count = own.shape[2]
    weighted = own * observations.weight[rows, None, None]
    gram = weighted.reshape(-1, count).T @ own.reshape(-1, count)
    sq_length = gram.diagonal().copy()
    points, track = np.unique(observations.point_idx[rows], return_inverse=True)
    jacobian = np.concatenate([observations.jacobian(image) for image in images])
    crossed = sum_by_track(jacobian.transpose(0, 2, 1) @ weighted, track, points.size)  # J^T E
    absorbed = base.point_inverse[points] @ crossed
    gram -= crossed.reshape(-1, count).T @ absorbed.reshape(-1, count)
    chunks = [(part, neighbourhood(observations, points[part])) for part in point_chunks(observations, points)]
    coupling = _Coupling(base, [around.images for _, around in chunks], count)
    coupling.add_own(fields, weighted)
    if not observations.points_independent:
        for part, around in chunks:
            coupling.subtract_tracks(around, absorbed[part])
    right = coupling.right[:-1]
    solution = base.inverse.block(coupling.support) @ right
    gram -= right.T @ solution
    track_score = np.einsum("nac,na->nc", weighted, base.left_px[rows])
    score = track_score.sum(axis=0)
    track_score = sum_by_track(track_score, track, points.size)
    padded = np.vstack([solution, np.zeros((1, count))])
    for part, around in chunks:
        track_score[part] -= coupling.scores(around, padded)
    return CandidateScores(
        sq_length, 0.5 * (gram + gram.T), score, track_score, right, coupling.support, solution, rows.size
    )


class _Coupling:
    """R at those columns of the base that the images around have, included fields among them.

    support: (s,) these columns.    right: (s + 1, c); the last row is padding.
    """

    def __init__(self, base: Base, images: list[IntArray], count: int) -> None:
        self._base = base
        layout = base.observations.layout
        around = np.unique(np.concatenate(images))
        columns = np.unique(layout.columns[around])
        columns = columns[columns < layout.num_columns]
        extra = [base.included[image].columns for image in around.tolist() if image in base.included]
        self.support = np.concatenate([columns, *sorted(extra, key=lambda own: int(own[0]))])
        self._place = np.full(base.inverse.size + 1, self.support.size)
        self._place[self.support] = np.arange(self.support.size)
        self.right = np.zeros((self.support.size + 1, count))

    def _places(self, images: IntArray | int) -> IntArray:
        """Rows of ``right`` of the columns of images; padding where they have none."""
        layout = self._base.observations.layout
        columns = layout.columns[images]
        return np.where(columns < layout.num_columns, self._place[columns], self.support.size)

    def add_own(self, fields: Mapping[int, ImageFields], weighted: FloatArray) -> None:
        """Add N^T E."""
        start = 0
        for image in sorted(fields):
            nuisance = fields[image].nuisance
            stop = start + len(nuisance)
            part = weighted[start:stop].reshape(2 * len(nuisance), -1)
            own = nuisance.reshape(2 * len(nuisance), -1)
            np.add.at(self.right, self._places(image), own.T @ part)
            extra = self._base.included.get(image)
            if extra is not None:
                self.right[self._place[extra.columns]] += extra.fields.reshape(len(part), -1).T @ part
            start = stop

    def subtract_tracks(self, around: Neighbourhood, absorbed: FloatArray) -> None:
        """Subtract W V^-1 J^T E; ``absorbed`` (T, 3, c) is V^-1 J^T E."""
        shared = around.gather(self._base.observations.crossed[around.views], absorbed)
        places = self._places(around.images)
        if np.unique(places).size == places.size:
            self.right[places] -= shared
        else:
            np.subtract.at(self.right, places, shared)
        for extra, own, within in self._included_near(around):
            seen = absorbed[around.track[own]].reshape(-1, absorbed.shape[2])
            crossed = extra.crossed[within].transpose(1, 0, 2).reshape(extra.columns.size, -1)
            self.right[self._place[extra.columns]] -= crossed @ seen

    def scores(self, around: Neighbourhood, solution: FloatArray) -> FloatArray:
        """(T, c) sum over the views of each track of B_k^T h_k; ``solution`` (s + 1, c) is B and a row of zeros."""
        base = self._base
        per_view = base.view_scores[around.by_track]
        out = around.scatter(per_view, solution[self._places(around.images)])
        for extra, own, within in self._included_near(around):
            views = around.views[own]
            left = base.left_px[views] * base.observations.weight[views, None]
            score = np.einsum("nar,na->nr", extra.fields[within], left)
            np.add.at(out, around.track[own], score @ solution[self._place[extra.columns]])
        return out

    def _included_near(self, around: Neighbourhood) -> list[tuple[IncludedFields, slice, IntArray]]:
        """Included fields of the images around, with their views and where these are among the image's."""
        included, offsets = self._base.included, self._base.observations.offsets
        if not included:
            return []
        return [
            (included[image], own, around.views[own] - int(offsets[image]))
            for image, own in around.segments()
            if image in included
        ]
