"""cereal's portable binary archive: numbers, strings and pointers in the order in which a program wrote them.

Facts, of cereal 1.3 (``cereal/archives/portable_binary.hpp``, ``types/*.hpp``, ``details/helpers.hpp``):

- the first byte says how the rest is ordered: 1 little-endian, 0 big-endian. Nothing has a name, and nothing is padded.
- strings, vectors and maps: their size as 64 bits, then their elements; an element of a map is its key, its value.
- a pointer is a number of 32 bits; with the highest bit set the object follows, without it was written before.
- a pointer to a class with virtual functions has the number of its kind before that: 0 is no object, the second
  highest bit alone the class that the program names anyway, the highest bit a kind whose name follows.
- what a base class writes stands where the derived class says so, without a mark.
"""

from __future__ import annotations

import struct
from io import BufferedReader
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.errors import LoadError, MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.paths.locations import InputPath

NEW: Final = 0x80000000
OWN_KIND: Final = 0x40000000
_MAX_TEXT: Final = 1 << 16
_ORDERS: Final = {1: "<", 0: ">"}


class PortableBinary:
    """A position in such a file; what was read is not kept.

    Parameters
    ----------
    path : the file
    file, size : as `open_input` gives them
    advice : what the user can do where it is none, or damaged

    Raises
    ------
    LoadError
        Where the first byte is none of an archive.
    """

    def __init__(self, path: InputPath, file: BufferedReader, size: int, advice: str) -> None:
        self.path: Final = path
        self.advice: Final = advice
        self.size: Final = size
        self.at = 0
        self._file = file
        self._ahead = b""
        self._kinds: dict[int, str] = {}
        first = self.read(1, "the order of bytes")[0]
        if first not in _ORDERS:
            raise self.malformed(0, "cereal's mark of the order of bytes, 0 or 1", f"{first}")
        self.order: Final = _ORDERS[first]

    @property
    def num_left(self) -> int:
        """How many bytes follow."""
        return self.size - self.at

    def peek(self, num_bytes: int) -> bytes:
        """Return the next bytes, as many as there are, and stay before them."""
        if len(self._ahead) < num_bytes:
            self._ahead += self._file.read(num_bytes - len(self._ahead))
        return self._ahead[:num_bytes]

    def read(self, num_bytes: int, what: str) -> bytes:
        """Return the next bytes; TruncatedFileError where there are fewer."""
        if self._ahead:
            found, self._ahead = self.peek(num_bytes), self._ahead[num_bytes:]
        else:
            found = self._file.read(num_bytes)
        if len(found) < num_bytes:
            raise self.truncated(self.at, f"{what} ({num_bytes} bytes)", len(found))
        self.at += num_bytes
        return found

    def malformed(self, at: int, wanted: str, got: str) -> LoadError:
        """Return the error for what stands at a byte."""
        return MalformedFileError(str(self.path), Position("byte", at), wanted, got, self.advice)

    def truncated(self, at: int, wanted: str, num_left: int) -> LoadError:
        """Return the error for a file that ends too early."""
        got = f"{num_left} bytes before the end of the file"
        advice = f"the file is cut short or damaged: {self.advice}"
        return TruncatedFileError(str(self.path), Position("byte", at), wanted, got, advice)

    def take(self, codes: str, what: str) -> tuple[float, ...]:
        """Return the numbers that `struct` codes name."""
        layout = struct.Struct(self.order + codes)
        return layout.unpack(self.read(layout.size, what))

    def whole(self, code: str, what: str) -> int:
        """Return one whole number."""
        return int(self.take(code, what)[0])

    def count(self, what: str, least_bytes: int) -> int:
        """Return the size of what follows; TruncatedFileError where so many elements do not fit into the file."""
        at = self.at
        found = self.whole("Q", f"a number of {what}")
        if found * least_bytes > self.num_left:
            raise self.truncated(at, f"{found} {what}, at least {found * least_bytes} bytes", self.num_left)
        return found

    def text(self, what: str) -> str:
        """Return a string."""
        at, size = self.at, self.count(f"characters of {what}", 1)
        if size > _MAX_TEXT:
            raise self.malformed(at, f"at most {_MAX_TEXT} characters of {what}", f"{size}")
        return self.read(size, what).decode("utf-8", errors="backslashreplace")

    def vector(self, length: int, what: str) -> tuple[float, ...]:
        """Return a vector of doubles that must have so many."""
        at, found = self.at, self.count(f"numbers of {what}", 8)
        if found != length:
            raise self.malformed(at, f"{length} numbers of {what}", f"{found}")
        return self.take(f"{length}d", what)

    def matrix(self, what: str) -> FloatArray:
        """Return a vector of three vectors of three doubles."""
        at, found = self.at, self.count(f"rows of {what}", 8)
        if found != 3:
            raise self.malformed(at, f"3 rows of {what}", f"{found}")
        return np.array([self.vector(3, what) for _ in range(3)])

    def kind(self, own: str, what: str) -> str:
        """Return the name of a pointer's kind; ``own``: of the class that a kind without a name means."""
        at, number = self.at, self.whole("I", f"the kind of {what}")
        if number == OWN_KIND:
            return own
        if number & NEW:
            self._kinds[number & ~NEW] = self.text(f"the kind of {what}")
        found = self._kinds.get(number & ~NEW)
        if found is None:
            raise self.malformed(at, f"the kind of {what}, or the number of one before it", f"{number}")
        return found

    def pointer(self, what: str) -> tuple[int, bool]:
        """Return a pointer's number and whether the object follows."""
        number = self.whole("I", f"the pointer to {what}")
        return number & ~NEW, bool(number & NEW)

    def finish(self, what: str) -> None:
        """Raise where bytes follow."""
        if self.peek(1):
            raise self.malformed(self.at, f"the end of the file after {what}", f"{self.num_left} more bytes")
