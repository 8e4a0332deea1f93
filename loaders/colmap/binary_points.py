"""points3D.bin: many small records of different lengths, read a piece of the file at a time.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_audit.loaders.arrays import IntArray, UInt32Array
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
_MANY: Final = 1 << 12  # and where none was seen
_PIECE_BYTES: Final = 1 << 21  # at a time: what is made of them stays in the cache, and takes few new pages
_FIRST_BYTES: Final = 1 << 16  # of the first piece, in which most damage shows
_MOST_AT_ONCE: Final = 1 << 22  # points or track elements for which memory is asked; it is touched when it is written


def read_points(path: InputPath) -> RawPoints:
    """Read points3D.bin, a piece in memory at a time."""
    points: _Columns = (np.empty(0, np.uint64), np.empty((0, 3)), np.empty(0), np.empty(0, np.int64))
    tracks: _Columns = (np.empty(0, np.uint32), np.empty(0, np.uint32))
    num_points = num_elements = 0
    for piece in point_pieces(path):
        records, elements = _records_of(piece)
        values = records["id"], records["xyz"], records["error"], records["track_length"]
        points, num_points = _put(points, num_points, values, piece.num_points)
        tracks, num_elements = _put(tracks, num_elements, (elements[:, 0], elements[:, 1]), piece.num_elements)
    ids, xyz, errors, lengths = (column[:num_points] for column in points)
    image_id, point2d_idx = (column[:num_elements] for column in tracks)

    def position(row: int) -> Position:
        return Position("byte", COUNT.size + row * _POINT3D.itemsize + 8 * int(lengths[:row].sum()))

    order = order_of_points(path, ids, position)
    return RawPoints(ids, xyz, errors, order, lengths, image_id, point2d_idx)


class _Piece(NamedTuple):
    """Some whole records of points3D.bin: ``data`` begins at byte ``at`` of the file, records at ``starts`` of it.

    num_points, num_elements: of the whole file, as its head and its size have it.
    """

    data: bytes
    at: int
    starts: IntArray
    num_points: int
    num_elements: int


def _records_of(piece: _Piece) -> tuple[npt.NDArray[np.void], UInt32Array]:
    """Return the records (p,) of `_POINT3D` and the elements (t, 2) of their tracks."""
    data, starts = piece.data, piece.starts
    # a view that begins a record at every byte; taking rows of it copies the records out
    windows = np.ndarray((len(data) - _POINT3D.itemsize + 1,), f"V{_POINT3D.itemsize}", data, strides=(1,))
    records = windows[starts].view(_POINT3D)
    lengths = records["track_length"].astype(np.int64)
    return records, _gather_tracks(data, starts + _POINT3D.itemsize, lengths)


_Columns = tuple[npt.NDArray[Any], ...]


def _put(columns: _Columns, num: int, values: _Columns, expected: int) -> tuple[_Columns, int]:
    """Write values behind the ``num`` that are there; return the columns, grown where needed, and how many there are.

    Memory for ``expected`` values is asked for at once, unless that is much: the count may be damage.
    """
    end = num + len(values[0])
    if end > len(columns[0]):
        size = max(end, min(expected, 2 * num + _MOST_AT_ONCE))
        grown = tuple(np.empty((size, *column.shape[1:]), column.dtype) for column in columns)
        for column, larger in zip(columns, grown, strict=True):
            larger[:num] = column[:num]
        columns = grown
    for column, value in zip(columns, values, strict=True):
        column[num:end] = value
    return columns, end


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
            if len(starts):
                piece = _Piece(data, at, starts, count, (size - COUNT.size - count * _POINT3D.itemsize) // 8)
                _check_ids(path, piece)
                yield piece
            row, at, data = row + len(starts), at + end, data[end:]
            num_wanted = _record_bytes(path, data, at, (row, count), size) - len(data) if row < count else 0
    check_end(path, at, size, "3D points")


def _point_starts(data: bytes, max_count: int) -> tuple[IntArray, int]:
    """Return where whole records begin, ``max_count`` at most, and where the last ends: 51 + 8 * track length bytes.

    The length is taken from the first of its eight bytes, which is fast, and compared with all of them afterwards.
    """
    parts: list[IntArray] = []
    offset, size, num_left, num_at_once = 0, len(data), max_count, _FEW
    while num_left > 0:
        found, after = _short_starts(data, offset, min(num_at_once, num_left))
        num_at_once = min(2 * num_at_once, _MANY) if len(found) == num_at_once else _FEW
        if len(found):
            is_whole = after <= size
            parts.append(found if is_whole else found[:-1])
            offset = after if is_whole else int(found[-1])
            num_left -= len(found)
            if not is_whole:
                break
            continue
        if offset + _POINT3D.itemsize > size:
            break
        end = offset + _POINT3D.itemsize + 8 * COUNT.unpack_from(data, offset + _TRACK_LENGTH_AT)[0]
        if end > size:
            break
        parts.append(np.array([offset], dtype=np.int64))
        num_left -= 1
        offset = end
    return np.concatenate([np.empty(0, dtype=np.int64), *parts]), offset


def _short_starts(data: bytes, offset: int, max_count: int) -> tuple[IntArray, int]:
    """Return where consecutive records from ``offset`` on begin, up to one whose track has 256 elements, and the end.

    The last one need not be whole.
    """
    at = _length_positions(data, offset + _TRACK_LENGTH_AT, max_count)
    places = np.fromiter(at, np.int64, len(at))
    windows = np.ndarray((max(0, len(data) - 7),), "V8", data, strides=(1,))
    num_whole = int(np.searchsorted(places, len(windows)))  # whose length can be read to its end
    is_long = np.flatnonzero(windows[places[:num_whole]].view("<u8") > np.uint64(len(_SIZE_BY_BYTE) - 1))
    num_short = int(is_long[0]) if len(is_long) else min(num_whole, len(at) - 1)
    return places[:num_short] - _TRACK_LENGTH_AT, at[num_short] - _TRACK_LENGTH_AT


def _length_positions(data: bytes, first: int, max_count: int) -> list[int]:
    """Return where the track lengths of ``max_count`` records lie, or of as many as there are, and of one more.

    Python's own loop, one step of it per 3D point: the length says where the next one lies.
    """
    sizes, at = _SIZE_BY_BYTE, first
    try:
        return [first, *[at := at + sizes[data[at]] for _ in range(max_count)]]
    except IndexError:  # behind the end of the data
        out, at = [first], first
        while at < len(data):
            at += sizes[data[at]]
            out.append(at)
        return out


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
