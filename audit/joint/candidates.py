"""What would candidate fields of some images take up that nothing in the base can? (method.md (7), never over all)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_audit.audit.joint.design import AT_ONCE, PART
from sfm_audit.audit.joint.neighbourhood import Neighbourhood, neighbourhood, point_chunks, sum_by_track
from sfm_audit.audit.joint.observations import design_crossed, design_scores
from sfm_audit.audit.joint.system import Base, IncludedFields
from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct


@dataclass(frozen=True, slots=True, eq=False)
class CandidateScores:
    """c candidate fields, projected off the base: sums that need nobody beyond who shares their tracks.

    sq_length: (c,) |E|^2 before the projection.    gram: (c, c) K.    score: (c,) u.
    meat: (c, c) sum of G_t^T G_t over the T tracks that the images see.    num_tracks: T.    Compiled sums leave K and
    this zero between a field along one axis and one with both components: no group has both.
    support: (s,) columns of the base that the fields meet.    basis_coupling, basis_solution: (s, f) R and B = S^+ R of
    the basis that the fields are made of.    fields: (f, c) how; None where they are the basis.
    num_observations: of the images.
    """

    sq_length: FloatArray
    gram: FloatArray
    score: FloatArray
    meat: FloatArray
    num_tracks: int
    basis_coupling: FloatArray
    support: IntArray
    basis_solution: FloatArray
    num_observations: int
    fields: FloatArray | None = None

    @property
    def coupling(self) -> FloatArray:
        """(s, c) R."""
        return self.basis_coupling if self.fields is None else self.basis_coupling @ self.fields

    @property
    def solution(self) -> FloatArray:
        """(s, c) B = S^+ R."""
        return self.basis_solution if self.fields is None else self.basis_solution @ self.fields

    def only(self, columns: slice) -> CandidateScores:
        """Return some of the fields; each was projected off the base alone, so that nothing else changes."""
        is_basis = self.fields is None
        return replace(
            self,
            sq_length=self.sq_length[columns],
            gram=self.gram[columns, columns],
            score=self.score[columns],
            meat=self.meat[columns, columns],
            basis_coupling=self.basis_coupling[:, columns] if is_basis else self.basis_coupling,
            basis_solution=self.basis_solution[:, columns] if is_basis else self.basis_solution,
            fields=None if self.fields is None else self.fields[:, columns],
        )


class ImageFields(NamedTuple):
    """Candidate fields (n_i, 2, c) px per unit of one image beside its nuisance columns (n_i, 2, C)."""

    fields: FloatArray
    nuisance: FloatArray

    def part(self, chosen: slice | IntArray) -> ImageFields:
        """Those of some of the observations."""
        return ImageFields(self.fields[chosen], self.nuisance[chosen])


class FieldsInParts(NamedTuple):
    """The same, calculated when asked for: a million points have 800 MB of fields."""

    part: Callable[[slice | IntArray], ImageFields]


def candidate_scores(
    base: Base, images: Sequence[int], fields_of: Callable[[int], ImageFields | FieldsInParts]
) -> CandidateScores:
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

    Where an image has more than 32,768 observations everything is gone through in parts, and what the tracks add up to
    comes in a second round. Sums are in the order of points, whatever the machine.
    """
    met = FieldsMet(base, images, fields_of, keep_scores=True)
    solution = base.inverse.within(met.support, met.right)
    padded = np.vstack([solution, np.zeros((1, len(met.gram)))])
    meat = np.zeros_like(met.gram)
    for part in met.parts:
        own_score = met.sums.track_scores(part) if met.in_parts else met.sums.track_score
        met.coupling.subtract_scores(own_score, met.around.of(part), padded, met.kept_scores)
        with np.errstate(over="ignore", invalid="ignore"):  # the test refuses what is not finite
            meat += own_score.T @ own_score
    return met.scores(solution, meat)


class FieldsMet:
    """What candidate fields meet: N^T E off the points, and their products among each other; see `candidate_scores`.

    support: (s,).    right: (s, c) R.    gram: (c, c) E^T E - (J^T E)^T V^-1 (J^T E).    sq_length: (c,).
    kept_scores: of the views, where they are asked for and at hand.
    """

    def __init__(
        self,
        base: Base,
        images: Sequence[int],
        fields_of: Callable[[int], ImageFields | FieldsInParts],
        *,
        keep_scores: bool = False,
    ) -> None:
        observations = base.observations
        points = _points_of(base, images)
        self._num_tracks, self._num_observations = points.size, sum(observations.num_of(image) for image in images)
        self.in_parts = any(observations.num_of(image) > AT_ONCE for image in images)
        self.parts = _parts(points.size) if self.in_parts else [slice(0, points.size)]
        self.around = _Surroundings(base, points, self.parts)
        self.coupling = _Coupling(base, self.around.images())
        self.sums = _OwnSums(base, points, self.coupling, images, fields_of)
        self.kept_scores: FloatArray | None = None
        keep = keep_scores and self.around.is_one
        for part in self.parts:
            absorbed = self.sums.add(part, in_parts=self.in_parts)
            for own, near in self.around.of(part) if not observations.points_independent else ():
                self.kept_scores = self.coupling.subtract_tracks(self.sums.right, near, absorbed[own], keep=keep)
        self.right, self.support, self.gram = self.sums.right[:-1], self.coupling.support, self.sums.gram
        self.sq_length = self.gram.diagonal().copy()
        for gone in self.sums.eliminated:
            self.gram -= gone

    def scores(self, solution: FloatArray, meat: FloatArray) -> CandidateScores:
        """Return the fields' scores; ``solution`` (s, c) is B, ``meat`` (c, c) that of the tracks."""
        gram = self.gram - self.right.T @ solution
        of_fields = self.sq_length, 0.5 * (gram + gram.T), self.sums.score, meat
        at = self.right, self.support, solution
        return CandidateScores(*of_fields, self._num_tracks, *at, self._num_observations)


def _points_of(base: Base, images: Sequence[int]) -> IntArray:
    """The distinct points that the images see."""
    observations = base.observations
    if len(images) == 1:
        return distinct(observations.point_idx[observations.rows(images[0])]).astype(np.int64)
    seen = np.zeros(observations.num_points, dtype=bool)
    for image in images:
        seen[observations.point_idx[observations.rows(image)]] = True
    return np.flatnonzero(seen)


def _parts(size: int) -> list[slice]:
    return [slice(start, min(start + PART, size)) for start in range(0, size, PART)]


class _Surroundings:
    """Who sees the points of a part: kept where there is one part, collected again where there are several."""

    def __init__(self, base: Base, points: IntArray, parts: list[slice]) -> None:
        self._observations, self._points, self._parts = base.observations, points, parts
        self._kept = list(self._collected(parts[0])) if len(parts) == 1 else None
        self.is_one = self._kept is not None and len(self._kept) == 1

    def _collected(self, part: slice) -> Iterator[tuple[slice, Neighbourhood]]:
        points = self._points[part]
        for own in point_chunks(self._observations, points):
            yield own, neighbourhood(self._observations, points[own])

    def of(self, part: slice) -> Iterable[tuple[slice, Neighbourhood]]:
        """Which of the part's points, and who sees these."""
        return self._collected(part) if self._kept is None else self._kept

    def images(self) -> list[IntArray]:
        """Images around."""
        return [near.images for part in self._parts for _, near in self.of(part)]


class _OwnSums:
    """What the images' own observations add up to, part by part of their points.

    gram: (c, c) E^T E.    score: (c,) E^T y~.    track_score: (T, c) the same of each track, of the last part.
    right: (s + 1, c) N^T E.    eliminated: (c, c) (J^T E)^T V^-1 (J^T E) of each part.
    """

    def __init__(
        self,
        base: Base,
        points: IntArray,
        coupling: _Coupling,
        images: Sequence[int],
        fields_of: Callable[[int], ImageFields | FieldsInParts],
    ) -> None:
        self._base, self._points, self._coupling = base, points, coupling
        self._images, self._fields_of = images, fields_of
        self.gram = self.right = self.score = self.track_score = np.zeros((0, 0))
        self.eliminated: list[FloatArray] = []

    def add(self, part: slice, *, in_parts: bool) -> FloatArray:
        """Add what the images see of a part of the points; return (T, 3, c) V^-1 J^T E of these points."""
        observations = self._base.observations
        crossed = np.zeros((0, 0, 0))
        for image in self._images:
            fields = self._fields_of(image)
            for chosen in self._chosen(image, part) if in_parts else _slices(observations.num_of(image)):
                own = fields.part(chosen)
                if not crossed.size:
                    count = own.fields.shape[2]
                    crossed = np.zeros((part.stop - part.start, 3, count))
                    self.track_score = np.zeros((part.stop - part.start, count))
                self._add(image, own, chosen, part, crossed)
        self.score = self.track_score.sum(axis=0) + (self.score if self.score.size else 0.0)
        absorbed = self._base.point_inverse[self._points[part]] @ crossed
        count = crossed.shape[2]
        self.eliminated.append(crossed.reshape(-1, count).T @ absorbed.reshape(-1, count))
        return np.asarray(absorbed)

    def track_scores(self, part: slice) -> FloatArray:
        """(T, c) E^T y~ of each track of a part of the points, once more."""
        self.track_score = np.zeros((part.stop - part.start, len(self.gram)))
        for image in self._images:
            fields = self._fields_of(image)
            for chosen in self._chosen(image, part):
                weight = self._base.observations.weight[self._base.observations.rows(image)][chosen, None, None]
                self._add_scores(image, fields.part(chosen).fields * weight, chosen, part)
        return self.track_score

    def _chosen(self, image: int, part: slice) -> list[IntArray]:
        """Observations of an image that show a part of the points."""
        point_idx = self._base.observations.point_idx[self._base.observations.rows(image)]
        first, last = self._points[part.start], self._points[part.stop - 1]
        found = np.flatnonzero((point_idx >= first) & (point_idx <= last))
        return [found] if found.size else []

    def _add(self, image: int, own: ImageFields, chosen: slice | IntArray, part: slice, crossed: FloatArray) -> None:
        observations = self._base.observations
        rows, count = observations.rows(image), own.fields.shape[2]
        weighted = own.fields * observations.weight[rows][chosen, None, None]
        flat = weighted.reshape(-1, count)
        if not self.gram.size:
            self.gram, self.right = np.zeros((count, count)), self._coupling.zeros(count)
        own_crossed = observations.jacobian(image, chosen).transpose(0, 2, 1) @ weighted
        at, track = self._add_scores(image, weighted, chosen, part)
        crossed[at] += sum_by_track(own_crossed, track, at.size)
        self.gram += flat.T @ own.fields.reshape(-1, count)
        self._coupling.add_own(self.right, image, own.nuisance, flat, chosen)

    def _add_scores(
        self, image: int, weighted: FloatArray, chosen: slice | IntArray, part: slice
    ) -> tuple[IntArray, IntArray]:
        """Add E^T y~; return which of the part's points the observations show (t,), and of which each is (n,)."""
        observations = self._base.observations
        rows = observations.rows(image)
        seen, track = np.unique(observations.point_idx[rows][chosen], return_inverse=True)
        at = np.searchsorted(self._points[part], seen)
        track_score = np.einsum("nac,na->nc", weighted, self._base.left_px[rows][chosen])
        self.track_score[at] += sum_by_track(track_score, track, seen.size)
        return at, track


def _slices(size: int) -> list[slice]:
    return [slice(start, min(start + AT_ONCE, size)) for start in range(0, size, AT_ONCE)]


class _Coupling:
    """R (s + 1, c) at those columns of the base that the images around have, included fields among them.

    support: (s,) these columns. The last row of R is padding.
    """

    def __init__(self, base: Base, images: list[IntArray]) -> None:
        self._base = base
        layout = base.observations.layout
        around = distinct(np.concatenate(images))
        columns = distinct(layout.columns[around])
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

    def add_own(
        self, right: FloatArray, image: int, nuisance: FloatArray, weighted: FloatArray, chosen: slice | IntArray
    ) -> None:
        """Add N^T E of one image, in place; ``weighted`` (2 n_i, c) is w E of the chosen observations."""
        own = nuisance.reshape(len(weighted), -1)
        np.add.at(right, self._places(image), own.T @ weighted)
        extra = self._base.included.get(image)
        if extra is not None:
            right[self._place[extra.columns]] += extra.fields[chosen].reshape(len(weighted), -1).T @ weighted

    def subtract_tracks(
        self, right: FloatArray, around: Neighbourhood, absorbed: FloatArray, *, keep: bool
    ) -> FloatArray | None:
        """Subtract W V^-1 J^T E, in place; ``absorbed`` (T, 3, c) is V^-1 J^T E. Return the views' scores to keep."""
        observations = self._base.observations
        design, weight = observations.weighted(around.views)
        shared = around.gather(design_crossed(design, weight), absorbed)
        shared = observations.transform[around.images].transpose(0, 2, 1) @ shared
        places = self._places(around.images)
        if distinct(places).size == places.size:
            right[places] -= shared
        else:
            np.subtract.at(right, places, shared)
        for extra, own, within in self._included_near(around):
            seen = absorbed[around.track[own]].reshape(-1, absorbed.shape[2])
            weighted = extra.fields[within] * observations.weight[around.views[own], None, None]
            crossed = weighted.transpose(0, 2, 1) @ observations.jacobian(extra.image_idx, within)  # w E^T J
            crossed = crossed.transpose(1, 0, 2).reshape(extra.columns.size, -1)
            right[self._place[extra.columns]] -= crossed @ seen
        return design_scores(design, weight, self._base.left_px[around.views]) if keep else None

    def subtract_scores(
        self,
        track_score: FloatArray,
        around: Iterable[tuple[slice, Neighbourhood]],
        solution: FloatArray,
        known: FloatArray | None,
    ) -> None:
        """Subtract `scores` from those of the tracks (T, c), in place."""
        for own, near in around:
            track_score[own] -= self.scores(near, solution, known)

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
