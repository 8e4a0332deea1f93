"""points3D.txt: many short lines of different lengths, parsed many at a time.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_text.cc``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray, UInt32Array, UInt64Array
from sfm_audit.loaders.assembly.raw import RawPoints, offsets_of, order_of_points
from sfm_audit.loaders.errors import LoadError, Position
from sfm_audit.loaders.paths.text_lines import TextFile, is_number, parse_uint, repr_token

_BATCH: Final = 4096
_NUM_FIXED: Final = 8
_EXACT: Final = 2.0**53
_WHOLE: Final = re.compile(rb"[+-]?[0-9]{1,10}")
_NUM_SAFE_DIGITS: Final = 10  # numbers of fewer are below 2^31
_LAYOUT: Final = "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX per track element"


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """Some lines' points: ids (p,), fixed (p, 8) as floats, tracks (t, 2), track lengths (p,).

    num_odd_colours: points whose colour COLMAP cannot read; it is not used here.
    """

    ids: UInt64Array
    fixed: FloatArray
    tracks: UInt32Array
    track_lengths: IntArray
    num_odd_colours: int = 0


def read_points(file: TextFile) -> RawPoints:
    """Read points3D.txt."""
    numbered = list(file.records())
    no_points = _Batch(np.empty(0, np.uint64), np.empty((0, 8)), np.empty((0, 2), np.uint32), np.empty(0, np.int64))
    batches = [_read_batch(file, numbered[i : i + _BATCH]) for i in range(0, len(numbered), _BATCH)]
    batches.append(no_points)
    ids = np.concatenate([batch.ids for batch in batches])
    fixed = np.concatenate([batch.fixed for batch in batches])
    tracks = np.concatenate([batch.tracks for batch in batches])
    return RawPoints(
        point3d_id=ids,
        xyz_world=fixed[:, 1:4].copy(),
        stored_error_px=fixed[:, 7].copy(),
        order=order_of_points(file.path, ids, lambda row: Position("line", numbered[row][0])),
        track_lengths=np.concatenate([batch.track_lengths for batch in batches]),
        track_image_id=tracks[:, 0].copy(),
        track_point2d_idx=tracks[:, 1].copy(),
        num_unused_nonfinite=sum(batch.num_odd_colours for batch in batches),
    )


def _read_batch(file: TextFile, numbered: list[tuple[int, bytes]]) -> _Batch:
    """Parse some lines at once; what is wrong with which line is found out only where something is wrong."""
    rows = [record.split() for _, record in numbered]
    lengths = np.array([len(row) for row in rows], dtype=np.int64)
    if bool(np.any((lengths < _NUM_FIXED) | (lengths % 2 == 1))):
        raise _explain(file, numbered, rows)
    try:
        values = np.array(list(chain.from_iterable(rows)), dtype=np.float64)
    except ValueError:
        raise _explain(file, numbered, rows) from None
    offsets = offsets_of(lengths)
    at = np.arange(len(values)) - np.repeat(offsets[:-1], lengths)
    tracks = values[at >= _NUM_FIXED]
    ids = values[offsets[:-1]]
    if not _are_ids(tracks, 2.0**32) or any(b"_" in record for _, record in numbered):
        raise _explain(file, numbered, rows)
    if _are_ids(ids, _EXACT):
        exact_ids = ids.astype(np.uint64)
    else:
        pairs = zip(numbered, rows, strict=True)
        exact = [parse_uint(file, line, row[0], "a 3D point id", 64) for (line, _), row in pairs]
        exact_ids = np.array(exact, dtype=np.uint64)
    fixed = values[at < _NUM_FIXED].reshape(-1, _NUM_FIXED)
    tracks_of_images = tracks.astype(np.uint32).reshape(-1, 2)
    return _Batch(exact_ids, fixed, tracks_of_images, (lengths - _NUM_FIXED) // 2, _num_odd_colours(rows))


def _num_odd_colours(rows: list[list[bytes]]) -> int:
    """Count the points whose colour is not three whole numbers, as COLMAP reads them: 1.0 is none."""
    colours = [token for row in rows for token in row[4:7]]
    if b"".join(colours).isdigit() and len(max(colours, key=len)) < _NUM_SAFE_DIGITS:
        return 0
    return sum(not all(_WHOLE.fullmatch(token) and abs(int(token)) < 2**31 for token in row[4:7]) for row in rows)


def _are_ids(values: FloatArray, bound: float) -> bool:
    return bool(np.all((values >= 0) & (values < bound) & (values == np.floor(values))))


def _explain(file: TextFile, numbered: list[tuple[int, bytes]], rows: list[list[bytes]]) -> LoadError:
    """Return the error of the first wrong line."""
    for (line, _), row in zip(numbered, rows, strict=True):
        if len(row) < _NUM_FIXED or len(row) % 2:
            return file.malformed(line, _LAYOUT, f"{len(row)} values")
        wrong = next((token for token in row if not is_number(token)), None)
        if wrong is not None:
            return file.malformed(line, f"{_LAYOUT}, all numbers", repr_token(wrong))
        wrong = next((token for token in row[_NUM_FIXED:] if not _are_ids(np.array([float(token)]), 2.0**32)), None)
        if wrong is not None:
            return file.malformed(line, "IMAGE_ID and POINT2D_IDX (whole numbers below 2^32)", repr_token(wrong))
    return file.malformed(numbered[0][0], _LAYOUT, "something else")
