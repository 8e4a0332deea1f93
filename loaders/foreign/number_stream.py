"""Text files that are one stream of numbers, line ends being blanks like others: Bundler, BAL, NVM's points."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import LoadError, MalformedFileError
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.text_lines import TextFile, is_number, repr_token

_LINES_AT_ONCE: Final = 1 << 14
_MAX_COUNT: Final = 2**31
_EXACT: Final = 2.0**53


class NumberStream:
    """The numbers of the lines of a text file from line ``first`` (from 0) on, taken one after the other."""

    def __init__(self, file: TextFile, first: int = 0, last: int | None = None) -> None:
        self.file = file
        self._first = first
        self._lines = file.lines[first:last]
        self.values = self._parse()
        self.at = 0

    def _parse(self) -> FloatArray:
        parts = []
        for start in range(0, len(self._lines), _LINES_AT_ONCE):
            tokens = b" ".join(self._lines[start : start + _LINES_AT_ONCE]).split()
            try:
                parts.append(np.array(tokens, dtype=np.float64))
            except ValueError:
                raise self._no_number(start) from None
            if any(b"_" in token for token in tokens):  # Python reads 1_0 as 10
                raise self._no_number(start)
        return np.concatenate([np.empty(0), *parts])

    def _no_number(self, start: int) -> MalformedFileError:
        for row, line in enumerate(self._lines[start : start + _LINES_AT_ONCE]):
            wrong = next((token for token in line.split() if not is_number(token)), None)
            if wrong is not None:
                return self.file.malformed(self._first + start + row + 1, "numbers", repr_token(wrong))
        return self.file.malformed(self._first + start + 1, "numbers", "something else")

    def line_of(self, at: int) -> int:
        """Return the line (from 1) that holds number ``at``."""
        left = at
        for row, line in enumerate(self._lines):
            left -= len(line.split())
            if left < 0:
                return self._first + row + 1
        return len(self.file.lines)

    def take(self, count: int, what: str) -> FloatArray:
        """Return the next ``count`` numbers; TruncatedFileError where there are fewer."""
        if count > len(self.values) - self.at:
            raise self.file.truncated(what, "the end of the file")
        self.at += count
        return self.values[self.at - count : self.at]

    def count(self, what: str) -> int:
        """Return the next number, which counts something."""
        (value,) = self.take(1, what)
        if not (0 <= value < _MAX_COUNT and value == int(value)):
            raise self.malformed(self.at - 1, f"{what} (a whole number)", f"{value:g}")
        return int(value)

    def whole(self, rows: IntArray, limit: int, what: str) -> IntArray:
        """Return the numbers at ``rows`` as whole numbers from 0 to ``limit`` - 1; MalformedFileError where not."""
        values = self.values[rows]
        is_right = (values >= 0) & (values < min(limit, _EXACT)) & (values == np.floor(values))
        if not is_right.all():
            wrong = int(np.argmin(is_right))
            raise self.malformed(int(rows[wrong]), f"{what} below {limit}", f"{values[wrong]:g}")
        return values.astype(np.int64)

    def malformed(self, at: int, wanted: str, got: str) -> LoadError:
        """Return the error for number ``at``."""
        return self.file.malformed(self.line_of(at), wanted, got)

    def end(self) -> tuple[Finding, ...]:
        """Raise where numbers are left; return the finding for a file that does not end its last line."""
        if self.at < len(self.values):
            raise self.malformed(self.at, "the end of the file", f"{len(self.values) - self.at} more numbers")
        return unterminated(self.file)


def unterminated(file: TextFile) -> tuple[Finding, ...]:
    """Return the finding for a file that does not end its last line."""
    if file.is_terminated:
        return ()
    text = f"{file.path.name} does not end its last line: its last number may be cut"
    return (Finding(FindingCode.UNTERMINATED_TEXT, 1, text),)


def track_rows(stream: NumberStream, count: int, *, head: int, width: int) -> tuple[IntArray, IntArray, IntArray]:
    """Walk over ``count`` points of ``head`` numbers, the last of which counts observations of ``width`` numbers.

    Returns
    -------
    tuple
        (P,) where each point begins, (P,) its number of observations, (M,) where each observation begins.
    """
    if count * head > len(stream.values) - stream.at:
        raise stream.file.truncated(f"{count} points", "the end of the file")
    begins, lengths = np.empty(count, np.int64), np.empty(count, np.int64)
    for row in range(count):
        begins[row] = stream.at
        stream.take(head - 1, f"{count} points")
        lengths[row] = stream.count("a number of observations")
        stream.take(width * int(lengths[row]), "the observations of a point")
    within = np.arange(int(lengths.sum()), dtype=np.int64) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return begins, lengths, np.repeat(begins + head, lengths) + width * within
