"""Whether the images' own point ids and the points' tracks agree."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sfm_audit.loaders.arrays import IntArray, UInt64Array
from sfm_audit.loaders.assembly.lookup import rows_of
from sfm_audit.loaders.assembly.raw import RawPoints, offsets_of
from sfm_audit.loaders.model import Finding, FindingCode, ObservationTable, SparseModel

_CHUNK: Final = 1 << 18  # track elements at a time: what is needed beside the tables stays small


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
    num_links = np.bincount(model.observations.point_idx + 1, minlength=len(model.points) + 1)[1:]
    checks = (
        _tracks_disagree(model, points) if points.has_tracks else None,
        _dangling(model),
        _points_with(model, num_links == 0, FindingCode.UNSEEN_POINTS, "no image links to"),
        _points_with(model, num_links == 1, FindingCode.SHORT_TRACKS, "only one 2D point links to"),
        _repeated(model),
    )
    return tuple(finding for finding in checks if finding)


def compare_tracks(model: SparseModel, points: RawPoints) -> TrackDifference:
    """Compare the sets of (image, POINT2D index, point) of the images and of the tracks."""
    images, observations = model.images, model.observations
    first_point2d = offsets_of(images.num_points2d)
    row_at = _rows_by_position(observations, first_point2d)
    point_of_row = np.append(observations.point_idx, -1)  # row -1: no observation there
    rank = np.empty(len(points.order), dtype=np.int64)
    rank[points.order] = np.arange(len(points.order))
    track_point_idx = np.repeat(rank, points.track_lengths)
    image_ids = images.image_id.astype(np.uint64)

    has_track = observations.point_idx < 0
    loose: list[IntArray] = []
    for start in range(0, len(track_point_idx), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        image_idx = rows_of(image_ids, points.track_image_id[chunk].astype(np.uint64))
        point2d_idx = points.track_point2d_idx[chunk]
        exists = image_idx >= 0
        exists[exists] = point2d_idx[exists] < images.num_points2d[image_idx[exists]]
        row = row_at[np.where(exists, first_point2d[image_idx] + point2d_idx, -1)]
        is_confirmed = point_of_row[row] == track_point_idx[chunk]
        has_track[row[is_confirmed]] = True
        loose.append(start + np.flatnonzero(~is_confirmed))
    elements = np.concatenate([np.empty(0, np.int64), *loose])
    only_in_tracks = np.column_stack(
        [
            points.track_image_id[elements].astype(np.uint64),
            points.track_point2d_idx[elements].astype(np.uint64),
            model.points.point3d_id[track_point_idx[elements]],
        ]
    )
    return TrackDifference(np.flatnonzero(~has_track), _unique_rows(only_in_tracks))


def _unique_rows(rows: UInt64Array) -> UInt64Array:
    """Return the different rows in order; numpy's unique along an axis takes five times as long."""
    rows = rows[np.lexsort(rows.T[::-1])]
    is_new = np.ones(len(rows), dtype=np.bool_)
    is_new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return rows[is_new]


def _rows_by_position(observations: ObservationTable, first_point2d: IntArray) -> npt.NDArray[np.int32]:
    """Return the row of the observation at each place of all POINTS2D, -1 where nothing is linked, and last of all."""
    row_at = np.full(int(first_point2d[-1]) + 1, -1, dtype=np.int32)
    for image_idx, (first, last) in enumerate(pairwise(observations.offsets.tolist())):
        row_at[first_point2d[image_idx] + observations.point2d_idx[first:last]] = np.arange(first, last, dtype=np.int32)
    return row_at


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
