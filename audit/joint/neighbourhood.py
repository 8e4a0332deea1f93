"""Who else sees these points? Sums over all views of the tracks of an image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from sfm_audit.audit.joint.design import AT_ONCE
from sfm_audit.audit.joint.observations import JointObservations
from sfm_audit.loaders.arrays import FloatArray, IntArray

_VIEWS_AT_ONCE: Final = 200_000
_VIEWS_OF_LARGE: Final = 2**15  # of points of an image so large that it is gone through in parts


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """All views of some points (T,), by image and by track.

    points: (T,).      images: (m,) who sees any of them.    starts: (m + 1,) views of image k: starts[k]:starts[k + 1].
    views: (v,) rows of the observations, by image.    track: (v,) which of the points each shows.
    order: (v,) where each view stands by track.    image_of: (v,) by track, which of the images.
    ends: (T + 1,) by track, the views of track t are those from ends[t] to ends[t + 1].
    """

    points: IntArray
    images: IntArray
    starts: IntArray
    views: IntArray
    track: IntArray
    order: IntArray
    image_of: IntArray
    ends: IntArray

    def from_image(self, image_idx: int) -> Neighbourhood:
        """Return the views of an image and of those behind it; in the order by image only."""
        k = int(np.searchsorted(self.images, image_idx))
        start = self.starts[k]
        none = np.zeros(0, dtype=np.int64)
        return Neighbourhood(
            self.points,
            self.images[k:],
            self.starts[k:] - start,
            self.views[start:],
            self.track[start:],
            order=none,
            image_of=none,
            ends=none,
        )

    def segments(self) -> Iterator[tuple[int, slice]]:
        """Each image with its views."""
        bounds = self.starts.tolist()
        for k, image in enumerate(self.images.tolist()):
            yield image, slice(bounds[k], bounds[k + 1])

    def gather(self, per_view: FloatArray, per_point: FloatArray) -> FloatArray:
        """Return (m, C, c): sum over the views of each image of per_view^T per_point.

        Parameters
        ----------
        per_view : (v, a, C), by image        per_point : (T, a, c)
        """
        depth, width, count = per_view.shape[1], per_view.shape[2], per_point.shape[2]
        out = np.empty((len(self.images), width, count))
        flat, track = per_view.reshape(-1, width), self.track
        for k, (_, own) in enumerate(self.segments()):
            left = flat[depth * own.start : depth * own.stop]
            np.matmul(left.T, per_point.take(track[own], axis=0).reshape(-1, count), out=out[k])
        return out

    def scatter(self, per_view: FloatArray, per_image: FloatArray) -> FloatArray:
        """Return (T, c): sum over each point's views of per_view per_image.

        Parameters
        ----------
        per_view : (v, C), by image        per_image : (m, C, c)
        """
        by_track = np.empty_like(per_view)
        by_track[self.order] = per_view
        width = per_view.shape[1]
        indices = (width * self.image_of[:, None] + np.arange(width, dtype=np.int32)).astype(np.int32)
        matrix = sparse.csr_array(
            (by_track.reshape(-1), indices.reshape(-1), (width * self.ends).astype(np.int32)),
            shape=(len(self.points), width * len(self.images)),
        )
        return np.asarray(matrix @ per_image.reshape(-1, per_image.shape[2]))


def neighbourhood(observations: JointObservations, points: IntArray) -> Neighbourhood:
    """Collect all views of the given, distinct points."""
    first, last = observations.point_offsets[points], observations.point_offsets[points + 1]
    counts = last - first
    ends = np.concatenate([[0], np.cumsum(counts)])
    position = np.arange(int(ends[-1])) + np.repeat(first - ends[:-1], counts)
    by_track = observations.by_point[position]
    track = np.repeat(np.arange(points.size), counts)
    image = observations.image_idx[by_track]
    seen = np.zeros(len(observations.offsets) - 1, dtype=bool)
    seen[image] = True
    images = np.flatnonzero(seen)
    image_of = (np.cumsum(seen) - 1)[image]
    small = image_of.astype(np.uint16) if len(images) < 2**16 else image_of  # sorted by radix
    order = np.argsort(small, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(image_of, minlength=len(images)))])
    return Neighbourhood(points, images, starts, by_track[order], track[order], order, image_of, ends)


def point_chunks(observations: JointObservations, points: IntArray) -> Iterator[slice]:
    """Ranges of ``points`` with a bounded number of views each."""
    counts = observations.point_offsets[points + 1] - observations.point_offsets[points]
    chunk = np.cumsum(counts) // (_VIEWS_OF_LARGE if points.size > AT_ONCE else _VIEWS_AT_ONCE)
    bounds = np.concatenate([np.flatnonzero(np.diff(chunk, prepend=-1)), [points.size]])
    for start, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        yield slice(start, stop)


def sum_by_track(values: FloatArray, track: IntArray, num_tracks: int) -> FloatArray:
    """Return (T, ...): sums of the values (n, ...) that belong to each track."""
    if values.shape[0] == num_tracks:  # every track once
        out = np.empty(values.shape)
        out[track] = values
        return out
    flat = values.reshape(values.shape[0], -1)
    selector = sparse.csr_array((np.ones(track.size), (track, np.arange(track.size))), shape=(num_tracks, track.size))
    return np.asarray(selector @ flat).reshape(num_tracks, *values.shape[1:])
