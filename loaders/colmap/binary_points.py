"""points3D.bin: many small records of different lengths, read a piece of the file at a time.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray, UInt32Array, UInt64Array
from sfm_audit.loaders.assembly.raw import RawPoints, order_of_points
from sfm_audit.loaders.colmap.binary_file import COUNT, check_count, check_end, truncated
from sfm_audit.loaders.errors import Position
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

_POINT3D: Final = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")]
)
_TRACK_LENGTH_AT: Final = 43
_SIZE_BY_BYTE: Final = tuple(_POINT3D.itemsize + 8 * length for length in range(256))
_FEW: Final = 1 << 4  # records between two looks at their lengths, where long tracks are about
_MANY: Final = 1 << 14  # and where none was seen
_PIECE_BYTES: Final = 1 << 23  # in memory at a time
_FIRST_BYTES: Final = 1 << 16  # of the first piece, in which most damage shows


def read_points(path: InputPath) -> RawPoints:
    """Read points3D.bin, a piece in memory at a time."""
    parts = [_points_of(piece) for piece in point_pieces(path)]
    ids, xyz, errors, lengths, tracks, starts = (
        np.concatenate(columns) for columns in zip(_NO_POINTS, *parts, strict=True)
    )
    return RawPoints(
        point3d_id=ids,
        xyz_world=xyz,
        stored_error_px=errors,
        order=order_of_points(path, ids, lambda row: Position("byte", int(starts[row]))),
        track_lengths=lengths,
        track_image_id=tracks[:, 0].copy(),
        track_point2d_idx=tracks[:, 1].copy(),
    )


class _Piece(NamedTuple):
    """Some whole records of points3D.bin: ``data`` begins at byte ``at`` of the file, records at ``starts`` of it."""

    data: bytes
    at: int
    starts: IntArray


_PointColumns = tuple[UInt64Array, FloatArray, FloatArray, IntArray, UInt32Array, IntArray]
_NO_POINTS: Final[_PointColumns] = (
    np.empty(0, np.uint64),
    np.empty((0, 3)),
    np.empty(0),
    np.empty(0, np.int64),
    np.empty((0, 2), np.uint32),
    np.empty(0, np.int64),
)


def _points_of(piece: _Piece) -> _PointColumns:
    """Return ids, xyz (p, 3), stored errors, track lengths, tracks (t, 2), and where in the file the records begin."""
    data, starts = piece.data, piece.starts
    # a view that begins a record at every byte; taking rows of it copies the records out
    windows = np.ndarray((len(data) - _POINT3D.itemsize + 1,), f"V{_POINT3D.itemsize}", data, strides=(1,))
    records = windows[starts].view(_POINT3D)
    lengths = records["track_length"].astype(np.int64)
    tracks = _gather_tracks(data, starts + _POINT3D.itemsize, lengths)
    xyz, errors = records["xyz"].astype(np.float64), records["error"].astype(np.float64)
    return records["id"].astype(np.uint64), xyz, errors, lengths, tracks, starts + piece.at


def point_pieces(path: InputPath) -> Iterator[_Piece]:
    """Yield points3D.bin in pieces of whole records; LoadError where the records do not fill the file."""
    file, size = open_input(path)
    with file, reading(path):
        head = file.read(COUNT.size)
        if len(head) < COUNT.size:
            raise truncated(path, 0, "the number of 3D points", COUNT.size, len(head))
        (count,) = COUNT.unpack(head)
        check_count(path, 0, (count, "3D points"), _POINT3D.itemsize, size - COUNT.size)
        at, row, data, num_wanted, piece_bytes = COUNT.size, 0, b"", 0, min(_FIRST_BYTES, _PIECE_BYTES)
        while row < count:
            data += file.read(max(piece_bytes, num_wanted))
            piece_bytes = _PIECE_BYTES
            starts, end = _point_starts(data, count - row)
            if starts:
                piece = _Piece(data, at, np.array(starts, dtype=np.int64))
                _check_ids(path, piece)
                yield piece
            row, at, data = row + len(starts), at + end, data[end:]
            num_wanted = _record_bytes(path, data, at, (row, count), size) - len(data) if row < count else 0
    check_end(path, at, size, "3D points")


def _point_starts(data: bytes, max_count: int) -> tuple[list[int], int]:
    """Return where whole records begin, ``max_count`` at most, and where the last ends: 51 + 8 * track length bytes.

    The length is taken from the first of its eight bytes, which is fast, and compared with all of them afterwards.
    """
    starts: list[int] = []
    offset, size, num_at_once = 0, len(data), _FEW
    while len(starts) < max_count:
        found, after = _short_starts(data, offset, min(num_at_once, max_count - len(starts)))
        starts += found
        num_at_once = min(2 * num_at_once, _MANY) if len(found) == num_at_once else _FEW
        if found and after <= size:
            offset = after
            continue
        if found:  # the last one is not whole
            return starts[:-1], starts[-1]
        if offset + _POINT3D.itemsize > size:
            break
        end = offset + _POINT3D.itemsize + 8 * COUNT.unpack_from(data, offset + _TRACK_LENGTH_AT)[0]
        if end > size:
            break
        starts.append(offset)
        offset = end
    return starts, offset


def _short_starts(data: bytes, offset: int, max_count: int) -> tuple[list[int], int]:
    """Return where consecutive records from ``offset`` on begin, up to one whose track has 256 elements, and the end.

    The last one need not be whole.
    """
    starts: list[int] = []
    add, sizes, after = starts.append, _SIZE_BY_BYTE, offset
    try:
        for _ in range(max_count):
            size = sizes[data[after + _TRACK_LENGTH_AT]]
            add(after)
            after += size
    except IndexError:  # behind the end of the data
        pass
    while starts and starts[-1] + _POINT3D.itemsize > len(data):
        after = starts.pop()
    windows = np.ndarray((max(0, len(data) - 7),), "V8", data, strides=(1,))
    lengths = windows[np.array(starts, dtype=np.int64) + _TRACK_LENGTH_AT].view("<u8")
    is_long = np.flatnonzero(lengths > np.uint64(len(sizes) - 1))
    if len(is_long):
        after = starts[is_long[0]]
        del starts[is_long[0] :]
    return starts, after


def _record_bytes(path: InputPath, data: bytes, at: int, place: tuple[int, int], size: int) -> int:
    """Return the size of the record that begins at byte ``at``, as far as ``data`` says; LoadError where it is cut.

    ``place``: its row and the number of all rows.
    """
    row, count = place
    if size - at < _POINT3D.itemsize:
        raise truncated(path, at, f"3D point {row + 1} of {count}", _POINT3D.itemsize, size - at)
    if len(data) < _POINT3D.itemsize:
        return _POINT3D.itemsize
    length = COUNT.unpack_from(data, _TRACK_LENGTH_AT)[0]
    kind = f"elements of the track of 3D point {row + 1} of {count}"
    check_count(path, at + _TRACK_LENGTH_AT, (length, kind), 8, size - at - _POINT3D.itemsize)
    return _POINT3D.itemsize + 8 * int(length)


def _check_ids(path: InputPath, piece: _Piece) -> None:
    """Raise where an id occurs twice within a piece: a file of zeros is refused before all of it is read."""
    windows = np.ndarray((len(piece.data) - 7,), "V8", piece.data, strides=(1,))
    ids = windows[piece.starts].view("<u8")
    order_of_points(path, ids, lambda row: Position("byte", piece.at + int(piece.starts[row])))


def _gather_tracks(data: bytes, starts: IntArray, lengths: IntArray) -> UInt32Array:
    """Return (T, 2) image ids and POINT2D indices of the tracks that begin at the bytes ``starts``."""
    total = int(lengths.sum())
    if total == 0:
        return np.empty((0, 2), np.uint32)
    first = np.cumsum(lengths) - lengths
    at = np.arange(total, dtype=np.int64)
    at *= 8
    at += np.repeat(starts - 8 * first, lengths)
    windows = np.ndarray((len(data) - 7,), "V8", data, strides=(1,))
    return windows[at].view("<u4").reshape(-1, 2)
