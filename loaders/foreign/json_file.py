"""JSON files of bounded size, and their values with the errors that a wrong one deserves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

MAX_BYTES: Final = 1 << 30
MAX_VALUES: Final = 60_000_000
"""Python needs up to 200 bytes per value: a file of more values, or bytes, is refused before it is parsed."""


def read_json(path: InputPath, advice: str) -> Any:
    """Return the content of a JSON file in UTF-8.

    Raises
    ------
    LoadError
        As of `open_input`; MalformedFileError where the file is too large, no JSON, nested too deeply, or names a key
        of an object twice.
    """
    check_size(path)
    file, size = open_input(path)
    with file, reading(path):
        content = file.read(min(size, MAX_BYTES) + 1)  # all that is asked for is allocated
    if len(content) > MAX_BYTES:
        raise _too_large(path, size)
    num_values = sum(content.count(mark) for mark in (b",", b"[", b"{"))
    if num_values > MAX_VALUES:
        raise MalformedFileError(str(path), None, f"at most {MAX_VALUES} values", f"{num_values}", "split the model")
    try:
        return json.loads(content.decode("utf-8-sig"), object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        raise MalformedFileError(str(path), Position("line", error.lineno), "JSON", error.msg, advice) from None
    except RecursionError:
        raise MalformedFileError(str(path), None, "JSON", "values nested too deeply", advice) from None
    except ValueError as error:  # no UTF-8, a key twice, an integer of thousands of digits
        raise MalformedFileError(str(path), None, "JSON in UTF-8", str(error)[:120], advice) from None


def check_size(path: InputPath) -> None:
    """Raise MalformedFileError for a file that is too large to be read; other errors as of `open_input`."""
    file, size = open_input(path, only_head=True)
    file.close()
    if size > MAX_BYTES:
        raise _too_large(path, size)


def _too_large(path: InputPath, size: int) -> MalformedFileError:
    return MalformedFileError(str(path), None, f"at most {MAX_BYTES} bytes of JSON", f"{size}", "split the model")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice[:40]!r} twice in one object")
    return found


class JsonPlace:
    """A value of the file and the way that led to it, for messages."""

    def __init__(self, path: InputPath, advice: str, value: Any, where: str = "") -> None:
        self.path = path
        self.advice = advice
        self.value = value
        self.where = where

    def malformed(self, wanted: str, got: str) -> MalformedFileError:
        """Return the error for this value."""
        what = f"{wanted} at {self.where or 'the top'}"
        return MalformedFileError(str(self.path), None, what, got, self.advice)

    def at(self, key: str | int, value: Any) -> JsonPlace:
        """Return a place below this one."""
        return JsonPlace(self.path, self.advice, value, f"{self.where}.{key}" if self.where else str(key))

    def objects(self) -> Mapping[str, Any]:
        """Return the value, an object."""
        if not isinstance(self.value, dict):
            raise self.malformed("an object", kind(self.value))
        return self.value

    def items(self) -> Sequence[Any]:
        """Return the value, an array."""
        if not isinstance(self.value, list):
            raise self.malformed("an array", kind(self.value))
        return self.value

    def get(self, key: str) -> JsonPlace:
        """Return the place of a key that must be there."""
        found = self.objects()
        if key not in found:
            raise self.malformed(f"an object with the key {key!r}", f"one with {', '.join(list(found)[:6]) or 'none'}")
        return self.at(key, found[key])

    def find(self, key: str, default: Any) -> JsonPlace:
        """Return the place of a key that may be missing."""
        return self.at(key, self.objects().get(key, default))

    def number(self) -> float:
        """Return the value, a number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.malformed("a number", kind(self.value))
        return _float(self.value)

    def numbers(self, count: int) -> list[float]:
        """Return the value, an array of ``count`` numbers."""
        found = self.items()
        if len(found) != count:
            raise self.malformed(f"{count} numbers", f"{len(found)} values")
        return [self.at(row, value).number() for row, value in enumerate(found)]

    def whole(self, limit: int = 2**32) -> int:
        """Return the value, a whole number from 0 to ``limit`` - 1."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < limit:
            raise self.malformed(f"a whole number below {limit}", kind(value))
        return value

    def text(self) -> str:
        """Return the value, a string that can be written as UTF-8."""
        if not isinstance(self.value, str):
            raise self.malformed("a string", kind(self.value))
        return self.value.encode("utf-8", errors="backslashreplace").decode("utf-8")


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def kind(value: Any) -> str:
    """Return what a value is, as a message shows it."""
    names = {dict: "an object", list: "an array", str: "a string", bool: "true or false", type(None): "null"}
    return names.get(type(value)) or f"{value!r:.40}"


def rows(place: JsonPlace, values: Sequence[Any], width: int) -> FloatArray:
    """Return (n, width) numbers of a sequence of arrays; one place stands for all of them in messages.

    Raises
    ------
    MalformedFileError
        An element is no array of ``width`` numbers.
    """
    try:
        found = np.array(values, dtype=np.float64) if len(values) else np.empty((0, width))
    except (ValueError, TypeError, OverflowError):
        found = np.empty((0, 0))
    is_right = found.shape == (len(values), width)
    if not is_right or any(isinstance(number, str | bool) for row in values for number in row):
        for row, value in enumerate(values):
            place.at(row, value).numbers(width)
        return np.array([place.at(row, value).numbers(width) for row, value in enumerate(values)]).reshape(-1, width)
    return found
