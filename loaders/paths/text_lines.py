"""Text files line by line: comments, stated counts, line ends, and strict parsing of numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.errors import MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

_STATED_COUNT: Final = re.compile(rb"#\s*Number of (?:cameras|images|points|rigs|frames)\s*:\s*(\d{1,18})(?!\d)")
POINTS: Final = "3D points"
_BYTE_ORDER_MARK: Final = b"\xef\xbb\xbf"
_PIECE_BYTES: Final = 1 << 25
_MAX_LINE: Final = 1 << 20  # bytes, where a file is read line by line
_ADVICE: Final = "check that this is COLMAP's text format, or export the reconstruction again"
_RECOPY: Final = "copy or export the reconstruction again"


@dataclass(frozen=True, slots=True)
class TextFile:
    """The lines of one file; ``stated_count`` is N of its comment "# Number of ...: N", None without one.

    advice: what to do about a line that is not what it should be.
    """

    path: InputPath
    lines: list[bytes]
    stated_count: int | None
    is_terminated: bool
    advice: str = _ADVICE

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield line numbers (from 1) and lines that are neither blank nor comments, without surrounding blanks."""
        for number, line in enumerate(self.lines, start=1):
            stripped = line.strip()
            if stripped and not stripped.startswith(b"#"):
                yield number, stripped

    def malformed(self, line: int, wanted: str, got: str) -> MalformedFileError:
        """Return the error for a line that is not what it should be."""
        return MalformedFileError(str(self.path), Position("line", line), wanted, got, self.advice)

    def truncated(self, wanted: str, got: str) -> TruncatedFileError:
        """Return the error for a file that ends too early."""
        return TruncatedFileError(str(self.path), Position("line", len(self.lines)), wanted, got, _RECOPY)


class TextStream:
    """The lines of one file, one after the other, for a ``with`` block; a piece of the file is in memory.

    num_bytes: of the file.    num_lines: read so far.    is_terminated: whether the last line that was read has an end.
    """

    def __init__(self, path: InputPath, advice: str = _ADVICE) -> None:
        self.path = path
        self.num_lines = 0
        self.is_terminated = True
        self._advice = advice
        self._file, self.num_bytes = open_input(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield line numbers (from 1) and lines that are not blank, comments included, without surrounding blanks.

        Raises
        ------
        MalformedFileError
            A line holds a NUL byte, or is longer than 1 MiB.
        """
        with reading(self.path):
            while line := self._file.readline(_MAX_LINE + 1):
                self.num_lines += 1
                if self.num_lines == 1:
                    line = line.removeprefix(_BYTE_ORDER_MARK)
                if b"\0" in line:
                    raise self.malformed(self.num_lines, "text", "a NUL byte")
                if len(line) > _MAX_LINE:
                    raise self.malformed(self.num_lines, f"lines of at most {_MAX_LINE} bytes", "a longer one")
                self.is_terminated = line.endswith(b"\n")
                if stripped := line.strip():
                    yield self.num_lines, stripped

    def malformed(self, line: int, wanted: str, got: str) -> MalformedFileError:
        """Return the error for a line that is not what it should be."""
        return MalformedFileError(str(self.path), Position("line", line), wanted, got, self._advice)

    def truncated(self, wanted: str, got: str) -> TruncatedFileError:
        """Return the error for a file that ends too early."""
        return TruncatedFileError(str(self.path), Position("line", self.num_lines), wanted, got, _RECOPY)


def read_text(path: InputPath, advice: str = _ADVICE, *, may_be_empty: bool = False) -> TextFile:
    """Read a text file; errors as of `loaders.paths.files.open_input`, and MalformedFileError where it is no text."""
    lines: list[bytes] = []
    begun: list[bytes] = []  # pieces of a line that goes on
    for piece in _pieces(path, advice, may_be_empty=may_be_empty):
        first, *more = piece.split(b"\n")
        begun.append(first)
        if more:
            lines.append(b"".join(begun))
            begun = [more.pop()]
            lines += more
    lines.append(b"".join(begun))
    lines[0] = lines[0].removeprefix(_BYTE_ORDER_MARK)
    is_terminated = not lines[-1]
    if is_terminated:
        lines.pop()
    comments = (line for line in lines if line.lstrip().startswith(b"#"))
    stated = next((match for line in comments if (match := _STATED_COUNT.match(line.lstrip()))), None)
    return TextFile(path, lines, int(stated[1]) if stated else None, is_terminated, advice)


def check_text(path: InputPath, advice: str = _ADVICE, *, may_be_empty: bool = False) -> None:
    """Raise MalformedFileError where a file holds a NUL byte; nothing behind the first one is read."""
    for _ in _pieces(path, advice, may_be_empty=may_be_empty):
        pass


def _pieces(path: InputPath, advice: str, *, may_be_empty: bool) -> Iterator[bytes]:
    """Yield a file in pieces; raises at the first NUL byte."""
    file, _ = open_input(path, may_be_empty=may_be_empty)
    line = 1
    with file, reading(path):
        while piece := file.read(_PIECE_BYTES):
            nul = piece.find(b"\0")
            if nul >= 0:
                line += piece.count(b"\n", 0, nul)
                raise MalformedFileError(str(path), Position("line", line), "text", "a NUL byte", advice)
            line += piece.count(b"\n")
            yield piece


def check_count(
    file: TextFile, kind: str, count: int, *, has_missing: Callable[[], bool], needs_line_end: bool = False
) -> tuple[Finding, ...]:
    """Compare the number of records with the number that the file states.

    COLMAP and most other writers state the count in a comment and end every line. A file that states more records
    than it holds was cut, or its comment is wrong (public models have such comments): cut, if it holds none, or if
    the other files refer to a record that it does not hold. A cut inside the last number of the last line leaves a
    shorter, valid number: an unended line is a finding, and an error where fewer records than stated stand above it, or
    where nothing else could tell (``needs_line_end``).

    Parameters
    ----------
    file, kind, count : the file, what it lists, and how many of them were read
    has_missing : whether other files refer to records that the file lacks; asked only where that matters
    needs_line_end : whether a file that states its count, or holds no record, must end its last line

    Raises
    ------
    TruncatedFileError
        Where the file was cut.
    """
    stated = file.stated_count
    if count == 0 and stated is None and kind != POINTS:
        raise file.truncated(kind, "none, and no comment that says there are none")
    if not file.is_terminated and needs_line_end and (stated is not None or count == 0):
        raise file.truncated("a line end after the last line", "none, so its last number may be cut")
    is_short = stated is not None and count < stated
    if (is_short and (count == 0 or not file.is_terminated)) or (
        (is_short or (count == 0 and stated is None)) and has_missing()
    ):
        wanted = f"{stated} {kind}, as its own comment says" if is_short else f"the {kind} that other files refer to"
        raise file.truncated(wanted, f"{count}")
    findings: list[Finding] = []
    if stated is not None and count != stated:
        text = f"{file.path.name} says that it holds {stated} {kind}, and holds {count}"
        findings.append(Finding(FindingCode.STATED_COUNT_DIFFERS, abs(count - stated), text))
    if not file.is_terminated:
        text = f"{file.path.name} does not end its last line: its last number may be cut"
        findings.append(Finding(FindingCode.UNTERMINATED_TEXT, 1, text))
    return tuple(findings)


def parse_uint(file: TextFile, line: int, token: bytes, what: str, bits: int = 32) -> int:
    """Return the unsigned integer that ``token`` spells; never by way of a float."""
    if not token.isdigit() or len(token) > 20 or int(token) >= 2**bits:
        raise file.malformed(line, f"{what} (a whole number below 2^{bits})", repr_token(token))
    return int(token)


def parse_floats(file: TextFile, line: int, tokens: list[bytes], what: str) -> FloatArray:
    """Return the numbers that ``tokens`` spell; NaN and infinities are numbers here."""
    has_underscore = any(b"_" in token for token in tokens)  # Python reads 1_0 as 10
    try:
        values = np.array(tokens, dtype=np.float64)
    except ValueError:
        values = None
    if values is None or has_underscore:
        wrong = next(token for token in tokens if not is_number(token))
        raise file.malformed(line, f"{what}, numbers", repr_token(wrong))
    return values


def is_number(token: bytes) -> bool:
    """Whether ``token`` spells a number, NaN and infinities included."""
    try:
        float(token)
    except ValueError:
        return False
    return b"_" not in token


def repr_token(token: bytes) -> str:
    """Return ``token`` as an error message shows it."""
    text = token[:40].decode("utf-8", errors="backslashreplace")
    return f"'{text}...'" if len(token) > 40 else f"'{text}'"
