"""Laser scans in PTX, the text format of Leica's Cyclone that other scanners write too.

Source: https://paulbourke.net/dataformats/ptx (header, missing returns in its example), the readme of
https://github.com/daviddoria/PTXTools (order of points):

    columns (steps in pan), rows (steps in tilt), each on its own line
    4 lines of 3 numbers: position and axes of the scanner; not needed here
    4 lines of 4 numbers: transformation M of the points, for row vectors: (x y z 1) M, so the last line is the
    translation and the last column is 0 0 0 1
    columns x rows lines, all rows of the first column first: x y z intensity, or x y z intensity r g b

A direction without a return is ``0 0 0``. A file may hold several scans, one after the other; here it must hold one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.gridded_scan import GriddedScan
from sfm_audit.loaders.errors import MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import parse_location
from sfm_audit.loaders.paths.text_lines import repr_token

_BATCH: Final = 1 << 16  # lines that are parsed at once
_MAX_LINE: Final = 4096  # bytes; a longer one is no line of this format
_MIN_LINE: Final = 8  # bytes of "0 0 0 0" and the line's end
_HEADER_COUNTS: Final = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
_HEADER_NAMES: Final = (
    "the number of columns",
    "the number of rows",
    "the scanner's position",
    *("an axis of the scanner",) * 3,
    *("a line of the 4 x 4 transformation",) * 4,
)
_LINE_LENGTHS: Final = (4, 7)
_POINT: Final = "x y z intensity, or x y z intensity r g b"
_NUMBER: Final = re.compile(rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_ADVICE: Final = "check that this is a PTX file, or export the scan again"


def read_ptx(location: str | Path) -> GriddedScan:
    """Read the scan in a PTX file.

    Memory: the points as float64 (24 bytes a point), however long the lines are.

    Raises
    ------
    LoadError
        The file cannot be read, is no PTX file, holds fewer points than it states, more than one scan, or no point.
    """
    path = parse_location(location)
    file, size = open_input(path)
    with file, reading(path):
        lines = _Lines(str(path), file)
        num_columns, num_rows, transformation = _read_header(lines)
        num, most = num_columns * num_rows, size // _MIN_LINE
        if num > most + 1:  # the last line may lack its end
            wanted = f"{num} points, columns times rows, at least {num * _MIN_LINE} bytes"
            raise lines.truncated(wanted, f"a file of {size} bytes")
        xyz = _read_points(lines, num)
        rest = lines.next_filled()
    if rest is not None:
        wanted, got = "the end of the file after its scan", repr_token(rest)
        raise MalformedFileError(lines.path, lines.at(), wanted, got, "put each scan into a file of its own")
    is_missing = ~xyz.any(axis=1)
    if is_missing.all():
        raise MalformedFileError(lines.path, None, "a point", "a scan without any return", _ADVICE)
    for first in range(0, num, _BATCH):  # in place: the points are in memory once
        part = slice(first, first + _BATCH)
        with np.errstate(over="ignore", invalid="ignore"):  # told below
            xyz[part] = xyz[part] @ transformation[:3, :3] + transformation[3, :3]
        if not np.isfinite(xyz[part]).all():
            wanted = "points that its transformation leaves finite"
            raise MalformedFileError(lines.path, None, wanted, "numbers beyond those of a computer", _ADVICE)
    xyz[is_missing] = np.nan
    return GriddedScan(xyz.reshape(num_columns, num_rows, 3).transpose(1, 0, 2), lines.path)


@dataclass(slots=True)
class _Lines:
    """A text file, line after line; ``number`` is that of the line that was read last."""

    path: str
    file: BufferedReader
    number: int = 0

    def __iter__(self) -> Iterator[bytes]:
        while line := self.file.readline(_MAX_LINE + 1):
            self.number += 1
            if len(line) > _MAX_LINE:
                raise self.malformed(f"lines of at most {_MAX_LINE} bytes", "a longer one")
            yield line

    def next_filled(self) -> bytes | None:
        """Return the next line that is not blank, None at the end."""
        return next((line for line in self if line.strip()), None)

    def at(self) -> Position:
        return Position("line", self.number)

    def malformed(self, wanted: str, got: str) -> MalformedFileError:
        return MalformedFileError(self.path, self.at(), wanted, got, _ADVICE)

    def truncated(self, wanted: str, got: str) -> TruncatedFileError:
        return TruncatedFileError(self.path, self.at(), wanted, got, "copy or export the scan again")


def _read_header(lines: _Lines) -> tuple[int, int, FloatArray]:
    """Return the numbers of columns and rows, and the transformation (4, 4)."""
    header: list[FloatArray] = []
    for count, name in zip(_HEADER_COUNTS, _HEADER_NAMES, strict=True):
        line = next(iter(lines), None)
        if line is None:
            raise lines.truncated(name, "the end of the file")
        tokens = line.split()
        if len(tokens) != count:
            raise lines.malformed(f"{name}, {count} number{'s' if count > 1 else ''}", f"{len(tokens)} values")
        if count == 1 and not (tokens[0].isdigit() and len(tokens[0]) <= 9 and int(tokens[0]) > 0):
            raise lines.malformed(f"{name}, a whole number above 0", repr_token(tokens[0]))
        header.append(_numbers(lines, tokens, name))
    transformation = np.stack(header[6:])
    if not np.array_equal(transformation[:, 3], [0.0, 0.0, 0.0, 1.0]):
        got = " ".join(f"{value:g}" for value in transformation[:, 3])
        raise lines.malformed("a transformation whose last column is 0 0 0 1", got)
    return int(header[0][0]), int(header[1][0]), transformation


def _numbers(lines: _Lines, tokens: list[bytes], what: str) -> FloatArray:
    """Return the finite numbers that the tokens of the current line spell."""
    wrong = next((token for token in tokens if not _NUMBER.fullmatch(token)), None)
    if wrong is not None:
        raise lines.malformed(f"{what}, numbers", repr_token(wrong))
    values = np.array(tokens, dtype=np.float64)
    if not np.isfinite(values).all():
        raise lines.malformed(f"{what}, finite numbers", repr_token(tokens[int(np.argmin(np.isfinite(values)))]))
    return values


def _read_points(lines: _Lines, num: int) -> FloatArray:
    """Return the points (num, 3) as the file has them, scanner frame."""
    xyz = np.empty((num, 3))
    num_read, line_length = 0, 0
    while num_read < num:
        first = lines.number + 1
        batch = list(islice(lines, min(_BATCH, num - num_read)))
        if not batch:
            raise lines.truncated(f"{num} points, columns times rows", f"{num_read}")
        line_length = line_length or len(batch[0].split())
        values = _parse_quickly(batch, line_length)
        if values is None:
            values = _parse_strictly(_Lines(lines.path, lines.file, first), batch, line_length)
        xyz[num_read : num_read + len(batch)] = values
        num_read += len(batch)
    return xyz


def _parse_quickly(batch: list[bytes], line_length: int) -> FloatArray | None:
    """Return the points (m, 3) of some lines; None where something is odd about one of them."""
    if line_length not in _LINE_LENGTHS or not batch[0].strip() or any(b"\0" in line for line in batch):
        return None
    try:
        values = np.loadtxt(batch, dtype=np.float64, comments=None, encoding="ascii", ndmin=2)
    except ValueError:
        return None
    if values.shape != (len(batch), line_length) or not np.isfinite(values).all():
        return None
    return values[:, :3].copy()


def _parse_strictly(lines: _Lines, batch: list[bytes], line_length: int) -> FloatArray:
    """The same, one line at a time; raises at the first line that is not a point. ``lines`` stands at the first one."""
    points = []
    for line in batch:
        tokens = line.split()
        if len(tokens) not in _LINE_LENGTHS:
            raise lines.malformed(_POINT, f"{len(tokens)} values")
        if len(tokens) != line_length:
            raise lines.malformed(f"{line_length} values, as in the first point's line", f"{len(tokens)}")
        points.append(_numbers(lines, tokens, _POINT)[:3])
        lines.number += 1
    return np.stack(points)
