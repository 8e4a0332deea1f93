"""What would candidate fields of some images take up that nothing in the base can? (method.md (7), never over all)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from sfm_audit.audit.joint.neighbourhood import Neighbourhood, neighbourhood, point_chunks, sum_by_track
from sfm_audit.audit.joint.observations import design_crossed, design_scores
from sfm_audit.audit.joint.system import Base, IncludedFields
from sfm_audit.loaders.arrays import FloatArray, IntArray


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

    def only(self, columns: slice) -> CandidateScores:
        """Return some of the fields; each was projected off the base alone, so that nothing else changes."""
        return replace(
            self,
            sq_length=self.sq_length[columns],
            gram=self.gram[columns, columns],
            score=self.score[columns],
            track_score=self.track_score[:, columns],
            coupling=self.coupling[:, columns],
            solution=self.solution[:, columns],
        )


class ImageFields(NamedTuple):
    """Candidate fields (n_i, 2, c) px per unit of one image beside its nuisance columns (n_i, 2, C)."""

    fields: FloatArray
    nuisance: FloatArray


def candidate_scores(base: Base, images: Sequence[int], fields_of: Callable[[int], ImageFields]) -> CandidateScores:
    """Project candidate fields off the base and correlate them with what it leaves.

    Parameters
    ----------
    images : on which the fields live, each once        fields_of : asked once per image; all its observations;
        column j is one unknown for all images

    Notes
    -----
    y~ is orthogonal to J track by track and to N as a whole, so E~ itself is not needed:
    R = N^T E - W V^-1 J^T E,  B = S^+ R,  K = E^T E - (J^T E)^T V^-1 (J^T E) - R^T B,  u = E^T y~,
    G_t = sum over own views of E^T y~ - sum over all views k of the track of B_k^T N_k^T y~_k.
    """
    observations = base.observations
    points = _points_of(base, images)
    chunks = [(part, neighbourhood(observations, points[part])) for part in point_chunks(observations, points)]
    coupling = _Coupling(base, [around.images for _, around in chunks])
    sums = _OwnSums(base, points, coupling)
    for image in images:
        sums.add(image, fields_of(image))
    crossed, right, gram, track_score = sums.crossed, sums.right, sums.gram, sums.track_score
    sq_length, count = gram.diagonal().copy(), len(gram)
    absorbed = base.point_inverse[points] @ crossed
    gram -= crossed.reshape(-1, count).T @ absorbed.reshape(-1, count)
    view_scores: list[FloatArray | None] = []
    if not observations.points_independent:
        for part, around in chunks:
            view_scores.append(coupling.subtract_tracks(right, around, absorbed[part], keep=len(chunks) == 1))
    solution = base.inverse.within(coupling.support, right[:-1])
    gram -= right[:-1].T @ solution
    score = track_score.sum(axis=0)
    padded = np.vstack([solution, np.zeros((1, count))])
    for (part, around), known in zip_longest(chunks, view_scores):
        track_score[part] -= coupling.scores(around, padded, known)
    num_observations = sum(observations.num_of(image) for image in images)
    gram = 0.5 * (gram + gram.T)
    return CandidateScores(
        sq_length, gram, score, track_score, right[:-1], coupling.support, solution, num_observations
    )


def _points_of(base: Base, images: Sequence[int]) -> IntArray:
    """The distinct points that the images see."""
    observations = base.observations
    if len(images) == 1:
        return np.unique(observations.point_idx[observations.rows(images[0])])
    seen = np.zeros(observations.num_points, dtype=bool)
    for image in images:
        seen[observations.point_idx[observations.rows(image)]] = True
    return np.flatnonzero(seen)


class _OwnSums:
    """What the images' own observations add up to, image by image.

    gram: (c, c) E^T E.    crossed: (T, 3, c) J^T E.    track_score: (T, c) E^T y~.    right: (s + 1, c) N^T E.
    """

    def __init__(self, base: Base, points: IntArray, coupling: _Coupling) -> None:
        self._base, self._points, self._coupling = base, points, coupling
        self.gram = np.zeros((0, 0))
        self.crossed = self.track_score = self.right = np.zeros((0, 0))

    def add(self, image: int, own: ImageFields) -> None:
        """Add one image."""
        observations = self._base.observations
        rows, count = observations.rows(image), own.fields.shape[2]
        weighted = own.fields * observations.weight[rows, None, None]
        flat = weighted.reshape(-1, count)
        crossed = observations.jacobian(image).transpose(0, 2, 1) @ weighted
        track_score = np.einsum("nac,na->nc", weighted, self._base.left_px[rows])
        if not self.gram.size:
            num_tracks = self._points.size
            self.gram, self.right = np.zeros((count, count)), self._coupling.zeros(count)
            self.crossed, self.track_score = np.zeros((num_tracks, 3, count)), np.zeros((num_tracks, count))
        seen, track = np.unique(observations.point_idx[rows], return_inverse=True)
        at = np.searchsorted(self._points, seen)
        self.crossed[at] += sum_by_track(crossed, track, seen.size)
        self.track_score[at] += sum_by_track(track_score, track, seen.size)
        self.gram += flat.T @ own.fields.reshape(-1, count)
        self._coupling.add_own(self.right, image, own.nuisance, flat)


class _Coupling:
    """R (s + 1, c) at those columns of the base that the images around have, included fields among them.

    support: (s,) these columns. The last row of R is padding.
    """

    def __init__(self, base: Base, images: list[IntArray]) -> None:
        self._base = base
        layout = base.observations.layout
        around = np.unique(np.concatenate(images))
        columns = np.unique(layout.columns[around])
        columns = columns[columns < layout.num_columns]
        extra = [base.included[image].columns for image in around.tolist() if image in base.included]
        self.support = np.concatenate([columns, *sorted(extra, key=lambda own: int(own[0]))])
        self._place = np.full(base.inverse.size + 1, self.support.size)
        self._place[self.support] = np.arange(self.support.size)

    def _places(self, images: IntArray | int) -> IntArray:
        """Rows of ``right`` of the columns of images; padding where they have none."""
        layout = self._base.observations.layout
        columns = layout.columns[images]
        return np.where(columns < layout.num_columns, self._place[columns], self.support.size)

    def zeros(self, count: int) -> FloatArray:
        """R before anything was added, (s + 1, c)."""
        return np.zeros((self.support.size + 1, count))

    def add_own(self, right: FloatArray, image: int, nuisance: FloatArray, weighted: FloatArray) -> None:
        """Add N^T E of one image, in place; ``weighted`` (2 n_i, c) is w E."""
        own = nuisance.reshape(len(weighted), -1)
        np.add.at(right, self._places(image), own.T @ weighted)
        extra = self._base.included.get(image)
        if extra is not None:
            right[self._place[extra.columns]] += extra.fields.reshape(len(weighted), -1).T @ weighted

    def subtract_tracks(
        self, right: FloatArray, around: Neighbourhood, absorbed: FloatArray, *, keep: bool
    ) -> FloatArray | None:
        """Subtract W V^-1 J^T E, in place; ``absorbed`` (T, 3, c) is V^-1 J^T E. Return the views' scores to keep."""
        observations = self._base.observations
        design, weight = observations.weighted(around.views)
        shared = around.gather(design_crossed(design, weight), absorbed)
        shared = observations.transform[around.images].transpose(0, 2, 1) @ shared
        places = self._places(around.images)
        if np.unique(places).size == places.size:
            right[places] -= shared
        else:
            np.subtract.at(right, places, shared)
        for extra, own, within in self._included_near(around):
            seen = absorbed[around.track[own]].reshape(-1, absorbed.shape[2])
            crossed = extra.crossed[within].transpose(1, 0, 2).reshape(extra.columns.size, -1)
            right[self._place[extra.columns]] -= crossed @ seen
        return design_scores(design, weight, self._base.left_px[around.views]) if keep else None

    def scores(self, around: Neighbourhood, solution: FloatArray, known: FloatArray | None) -> FloatArray:
        """(T, c) sum over the views of each track of B_k^T h_k; ``solution`` (s + 1, c) is B and a row of zeros.

        ``known``: the views' scores where they are at hand.
        """
        base, observations = self._base, self._base.observations
        per_view = observations.scores(around.views, base.left_px) if known is None else known
        moved = observations.transform[around.images] @ solution[self._places(around.images)]
        out = around.scatter(per_view, moved)
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
