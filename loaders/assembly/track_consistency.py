"""Whether the images' own point ids and the points' tracks agree."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sfm_audit.loaders.arrays import BoolArray, IntArray, UInt64Array
from sfm_audit.loaders.assembly.lookup import rows_of
from sfm_audit.loaders.assembly.raw import RawPoints, offsets_of
from sfm_audit.loaders.model import Finding, FindingCode, ObservationTable, SparseModel

_CHUNK: Final = 1 << 17  # track elements at a time: what is needed beside the tables stays small


@dataclass(frozen=True, slots=True, eq=False)
class TrackDifference:
    """Links that only the images or only the tracks have.

    only_in_images: (a,) rows of the observation table (links to points that do not exist left out: they are dangling).
    only_in_tracks: (b, 3) image id, POINT2D index and point id of track elements that no image confirms, each once.
    """

    only_in_images: IntArray
    only_in_tracks: UInt64Array


def find_track_inconsistencies(model: SparseModel, points: RawPoints) -> tuple[Finding, ...]:
    """Return the findings about links, tracks, and the points that they share."""
    num_links = _num_links(model)
    checks = (
        _tracks_disagree(model, points) if points.has_tracks else None,
        _dangling(model),
        _points_with(model, num_links == 0, FindingCode.UNSEEN_POINTS, "no image links to"),
        _points_with(model, num_links == 1, FindingCode.SHORT_TRACKS, "only one 2D point links to"),
        _repeated(model),
    )
    return tuple(finding for finding in checks if finding)


def _num_links(model: SparseModel) -> IntArray:
    """(P,) observations of each point."""
    point_idx = model.observations.point_idx
    is_known = point_idx >= 0
    known = point_idx if is_known.all() else point_idx[is_known]
    return np.bincount(known, minlength=len(model.points))


def compare_tracks(model: SparseModel, points: RawPoints) -> TrackDifference:
    """Compare the sets of (image, POINT2D index, point) of the images and of the tracks."""
    images, observations = model.images, model.observations
    first_point2d = offsets_of(images.num_points2d)
    point_at = _points_by_position(observations, first_point2d)
    nowhere = len(point_at) - 1
    rank = np.empty(len(points.order), dtype=np.int32)
    rank[points.order] = np.arange(len(points.order), dtype=np.int32)
    track_point_idx = np.repeat(rank, points.track_lengths)
    image_ids, end_point2d = images.image_id.astype(np.uint64), np.append(first_point2d[1:], 0)  # 0: of no image

    is_in_track = np.zeros(len(point_at), dtype=np.bool_)
    loose: list[IntArray] = []
    for start in range(0, len(track_point_idx), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        image_idx = rows_of(image_ids, points.track_image_id[chunk])
        position = first_point2d.take(image_idx, mode="wrap") + points.track_point2d_idx[chunk]
        position[position >= end_point2d.take(image_idx, mode="wrap")] = nowhere
        is_confirmed = point_at.take(position) == track_point_idx[chunk]
        if is_confirmed.all():
            is_in_track[position] = True
        else:
            is_in_track[position[is_confirmed]] = True
            loose.append(start + np.flatnonzero(~is_confirmed))
    elements = np.concatenate([np.empty(0, np.int64), *loose])
    only_in_tracks = np.column_stack(
        [
            points.track_image_id[elements].astype(np.uint64),
            points.track_point2d_idx[elements].astype(np.uint64),
            model.points.point3d_id[track_point_idx[elements]],
        ]
    )
    return TrackDifference(_only_in_images(observations, first_point2d, is_in_track), _unique_rows(only_in_tracks))


def _only_in_images(observations: ObservationTable, first_point2d: IntArray, is_in_track: BoolArray) -> IntArray:
    """Rows of the observations with a point that are in no track, given which positions of all POINTS2D are in one."""
    if int(np.count_nonzero(is_in_track)) == int(np.count_nonzero(observations.point_idx >= 0)):
        return np.empty(0, dtype=np.int64)  # a position is in a track only where an observation has a point
    position = np.repeat(first_point2d[:-1], np.diff(observations.offsets)) + observations.point2d_idx
    return np.flatnonzero(~is_in_track[position] & (observations.point_idx >= 0))


def _unique_rows(rows: UInt64Array) -> UInt64Array:
    """Return the different rows in order; numpy's unique along an axis takes five times as long."""
    rows = rows[np.lexsort(rows.T[::-1])]
    is_new = np.ones(len(rows), dtype=np.bool_)
    is_new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return rows[is_new]


def _points_by_position(observations: ObservationTable, first_point2d: IntArray) -> npt.NDArray[np.int32]:
    """Return the row of the point at each place of all POINTS2D, -1 where none is linked, and last of all."""
    point_at = np.full(int(first_point2d[-1]) + 1, -1, dtype=np.int32)
    for image_idx, (first, last) in enumerate(pairwise(observations.offsets.tolist())):
        own = point_at[first_point2d[image_idx] : first_point2d[image_idx + 1]]
        own[observations.point2d_idx[first:last]] = observations.point_idx[first:last]
    return point_at


def _tracks_disagree(model: SparseModel, points: RawPoints) -> Finding | None:
    difference = compare_tracks(model, points)
    num_images, num_tracks = len(difference.only_in_images), len(difference.only_in_tracks)
    if not num_images + num_tracks:
        return None
    parts = []
    if num_images:
        row = int(difference.only_in_images[0])
        image = int(np.searchsorted(model.observations.offsets, row, side="right")) - 1
        point_id = model.points.point3d_id[model.observations.point_idx[row]]
        example = f"image {model.images.image_id[image]} to point {point_id}"
        parts.append(f"{num_images} of {len(model.observations)} links are in no track (e.g. {example})")
    if num_tracks:
        image_id, point2d_idx, point_id = difference.only_in_tracks[0].tolist()
        example = f"point {point_id} in image {image_id}, 2D point {point2d_idx}"
        parts.append(
            f"{num_tracks} of {len(points.track_image_id)} track elements are no image's link (e.g. {example})"
        )
    return Finding(FindingCode.TRACKS_DISAGREE, num_images + num_tracks, "; ".join(parts))


def _dangling(model: SparseModel) -> Finding | None:
    rows = np.flatnonzero(model.observations.point_idx < 0)
    if not len(rows):
        return None
    image = int(np.searchsorted(model.observations.offsets, int(rows[0]), side="right")) - 1
    total = len(model.observations)
    example = f"e.g. in image {model.images.image_id[image]}"
    text = f"{len(rows)} of {total} linked 2D points have the id of a 3D point that does not exist, {example}"
    return Finding(FindingCode.DANGLING_POINT_IDS, len(rows), text)


def _points_with(model: SparseModel, is_wrong: np.ndarray, code: FindingCode, what: str) -> Finding | None:
    rows = np.flatnonzero(is_wrong)
    if not len(rows):
        return None
    point_id = model.points.point3d_id[rows[0]]
    return Finding(code, len(rows), f"{what} {len(rows)} of {len(is_wrong)} 3D points, e.g. point {point_id}")


def _repeated(model: SparseModel) -> Finding | None:
    """Count 2D points beyond the first that link to the same 3D point in the same image."""
    observations = model.observations
    if not _any_repeated(model):
        return None
    num_points = max(len(model.points), 1)
    key = np.repeat(np.arange(len(model.images), dtype=np.int64) * num_points, np.diff(observations.offsets))
    key += observations.point_idx
    key = np.sort(key[observations.point_idx >= 0])
    repeated = np.flatnonzero(key[1:] == key[:-1])
    if not len(repeated):
        return None
    image, point = divmod(int(key[repeated[0]]), num_points)
    example = f"e.g. point {model.points.point3d_id[point]} in image {model.images.image_id[image]}"
    text = f"{len(repeated)} linked 2D points repeat a 3D point that their image has linked already, {example}"
    return Finding(FindingCode.REPEATED_OBSERVATIONS, len(repeated), text)


def _any_repeated(model: SparseModel) -> bool:
    """Whether an image links to a point twice, or perhaps only to points that do not exist: no order is needed."""
    observations = model.observations
    last_at = np.empty(len(model.points) + 1, dtype=np.int32)  # row -1: dangling
    bounds = observations.offsets.tolist()
    positions = np.arange(max((last - first for first, last in pairwise(bounds)), default=0), dtype=np.int32)
    for first, last in pairwise(bounds):
        own, position = observations.point_idx[first:last], positions[: last - first]
        last_at[own] = position
        if (last_at[own] != position).any():
            return True
    return False
