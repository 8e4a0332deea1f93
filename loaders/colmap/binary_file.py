"""What COLMAP's binary files have in common: little-endian records behind a count, and counts that must fit the file.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``; no padding, no checksum. Counts are compared with
the size of the file before memory is taken for them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BufferedReader
from typing import Final, TypeVar

from sfm_audit.loaders.assembly.raw import duplicate_id
from sfm_audit.loaders.errors import LoadError, MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

COUNT: Final = struct.Struct("<Q")
RECOPY: Final = "copy or export the reconstruction again"
DAMAGED: Final = f"the file is damaged: {RECOPY}"


class Cursor:
    """A position in a file of small records; only the record at hand is in memory."""

    def __init__(self, path: InputPath, file: BufferedReader, size: int) -> None:
        self.path = path
        self.offset = 0
        self.size = size
        self._file = file

    @property
    def num_left(self) -> int:
        """How many bytes follow."""
        return self.size - self.offset

    def unpack(self, layout: struct.Struct, what: str) -> tuple[int, ...]:
        """Return the fields of the next record part and step behind it."""
        data = self._file.read(layout.size)
        if len(data) < layout.size:
            raise truncated(self.path, self.offset, what, layout.size, len(data))
        self.offset += layout.size
        return layout.unpack(data)

    def count(self, kind: str, sizes: tuple[int, int | None]) -> int:
        """Return the number of records that the file announces; ``sizes``: the least and most bytes that one takes."""
        (count,) = self.unpack(COUNT, f"the number of {kind}")
        check_count(self.path, 0, (count, kind), sizes[0], self.num_left)
        if sizes[1] is not None and self.num_left > count * sizes[1]:
            got = f"{self.num_left} bytes"
            wanted = f"{count} {kind}, at most {count * sizes[1]} bytes"
            raise MalformedFileError(str(self.path), Position("byte", 0), wanted, got, DAMAGED)
        return count

    def finish(self, kind: str) -> None:
        """Raise where bytes follow the last record."""
        check_end(self.path, self.offset, self.size, kind)


_Record = TypeVar("_Record")


def read_records(
    path: InputPath, kind: str, sizes: tuple[int, int | None], read_one: Callable[[Cursor], tuple[int, _Record]]
) -> list[_Record]:
    """Read a file of small records: a count, then records that begin with an id that no other has."""
    file, size = open_input(path)
    records: dict[int, _Record] = {}
    with file, reading(path):
        cursor = Cursor(path, file, size)
        for _ in range(cursor.count(f"{kind}s", sizes)):
            start = cursor.offset
            item_id, record = read_one(cursor)
            if item_id in records:
                raise duplicate_id(path, Position("byte", start), kind, item_id)
            records[item_id] = record
        cursor.finish(f"{kind}s")
    return list(records.values())


def check_count(path: InputPath, offset: int, items: tuple[int, str], min_size: int, num_left: int) -> None:
    """Raise where that many items of at least ``min_size`` bytes cannot fit into what is left of the file."""
    count, kind = items
    if count * min_size > num_left:
        wanted = f"{count} {kind}, at least {count * min_size} bytes"
        advice = f"the file is cut short or damaged: {RECOPY}"
        raise TruncatedFileError(str(path), Position("byte", offset), wanted, f"{num_left} bytes", advice)


def check_end(path: InputPath, offset: int, size: int, kind: str) -> None:
    """Raise where the last record does not end where the file does."""
    if offset != size:
        got = f"{size - offset} more bytes"
        wanted = f"the end of the file after the last of its {kind}"
        raise MalformedFileError(str(path), Position("byte", offset), wanted, got, DAMAGED)


def truncated(path: InputPath, offset: int, what: str, num_wanted: int, num_left: int) -> LoadError:
    """Return the error for a file that ends before ``num_wanted`` bytes at ``offset``."""
    wanted = f"{what} ({num_wanted} bytes)"
    got = f"{max(num_left, 0)} bytes before the end of the file"
    return TruncatedFileError(str(path), Position("byte", offset), wanted, got, f"the file is cut short: {RECOPY}")
