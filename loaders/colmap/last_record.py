"""Is the last record of a text file that does not end its last line complete? Its other half is in another file.

Editors write such files, and so does a copy that was cut. A cut inside the last number leaves a shorter, valid one; but
each link between a 2D point and a 3D point is written twice, in the images file and in the tracks of the points file.
"""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.arrays import UInt64Array
from sfm_audit.loaders.assembly.raw import RawImages, RawPoints
from sfm_audit.loaders.paths.text_lines import TextFile

_WANTED = "a line end after the last line, or a last record that the tracks confirm"


def check_last_image(file: TextFile, images: RawImages, points: RawPoints) -> None:
    """Raise TruncatedFileError where the file does not end its last line and that line's 2D points are not the tracks'.

    What cannot be asked, because no point has a track, is refused where the file states its count, and told elsewhere.
    """
    image_id = _last_image_id(file)
    if image_id is None:
        return
    row = int(np.flatnonzero(images.image_id == image_id)[0])
    links = slice(*images.offsets[row : row + 2])
    is_known = bool(points.track_lengths.any())
    of_image = np.flatnonzero(points.track_image_id == image_id)
    point_ids = np.repeat(points.point3d_id, points.track_lengths)[of_image] if is_known else np.empty(0, np.uint64)
    here = _pairs(images.point2d_idx[links], images.point3d_id[links])
    there = _pairs(points.track_point2d_idx[of_image], point_ids)
    _refuse_difference(file, f"image {image_id}", here, there, is_known=is_known)


def check_last_point(file: TextFile, images: RawImages, points: RawPoints) -> None:
    """Raise TruncatedFileError where the file does not end its last line and that point's track is not the images'."""
    if file.is_terminated or not len(points.point3d_id) or _is_comment(file.lines[-1]):
        return
    point_id = points.point3d_id[-1]
    elements = slice(len(points.track_image_id) - int(points.track_lengths[-1]), None)
    linked = np.flatnonzero(images.point3d_id == point_id)
    image_row = np.searchsorted(images.offsets, linked, side="right") - 1
    here = _pairs(points.track_image_id[elements], points.track_point2d_idx[elements])
    there = _pairs(images.image_id[image_row], images.point2d_idx[linked])
    _refuse_difference(file, f"3D point {point_id}", here, there, is_known=bool(points.track_lengths.any()))


def _refuse_difference(file: TextFile, record: str, here: UInt64Array, there: UInt64Array, *, is_known: bool) -> None:
    if not is_known:
        if file.stated_count is not None and len(here):
            raise file.truncated(
                _WANTED, f"neither: no 3D point has a track, and the last number of {record} may be cut"
            )
        return
    if not np.array_equal(here, there):
        got = f"neither: {record} has {len(here)} links, {len(there)} by the other file, or other ones"
        raise file.truncated(_WANTED, got)


def _pairs(first: np.ndarray, second: np.ndarray) -> UInt64Array:
    """Return pairs (n, 2), each once, in order."""
    pairs: UInt64Array = np.unique(np.column_stack([first, second]).astype(np.uint64).reshape(-1, 2), axis=0)
    return pairs


def _is_comment(line: bytes) -> bool:
    stripped = line.strip()
    return not stripped or stripped.startswith(b"#")


def _last_image_id(file: TextFile) -> int | None:
    """Return the image whose 2D points the unended last line holds; None where it holds none."""
    if file.is_terminated or not file.lines:
        return None
    lines = iter(enumerate(file.lines))
    for _, header in lines:
        if _is_comment(header):
            continue
        row, _ = next(lines)
        if row == len(file.lines) - 1:
            return int(header.split(maxsplit=1)[0])
    return None
