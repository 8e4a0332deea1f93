"""What would a pickle cost to load? Its opcodes are followed without making the objects, and must stay within budgets.

The C unpickler trusts a file in ways that are costly: it makes room for as many memo entries and as long strings as a
few bytes name, and hashes keys, whose cost doubles with every level of shared tuples and whose recursion is not
bounded. Each budget is relative to the size of the file, so that no small file takes much time or memory.
"""

from __future__ import annotations

import pickle
import struct
from array import array
from collections.abc import Callable
from typing import Final


class RefusedPickleError(Exception):
    """A pickle that holds something else than numpy arrays and builtin containers, or is damaged; nothing was run."""


_MAX_HASH: Final = 1000  # steps, and levels, of one key
_NO_ENTRY: Final = 2**16 - 1
_MAX_LINE: Final = 4096  # bytes of a number or a name in the text opcodes
_MAX_INTEGER: Final = 64  # bytes
_MAX_KEY_DIGITS: Final = 23  # of such an integer, with its sign and an L
_MAX_KEY: Final = 9  # bytes of an integer as a key; of longer ones, any number can be chosen to collide
_OBJECT_BYTES: Final = (16 << 20, 16)  # of all objects: this much, and so many times the file
_HASHES: Final = (100_000, 16)

_SIZES: Final = {  # bytes of an object by opcode, CPython 3.11, 64 bit; what it holds is in the file
    pickle.EMPTY_SET: 216,
    pickle.FROZENSET: 216,
    pickle.EMPTY_DICT: 64,
    pickle.DICT: 64,
    pickle.EMPTY_LIST: 56,
    pickle.LIST: 56,
    pickle.REDUCE: 160,
    pickle.NEWOBJ: 160,
    pickle.OBJ: 160,
    pickle.INST: 160,
    pickle.TUPLE: 40,
    pickle.TUPLE1: 48,
    pickle.TUPLE2: 56,
    pickle.TUPLE3: 64,
}
_FIXED: Final = {  # leaves with an argument of so many bytes
    pickle.NONE: 0,
    pickle.NEWTRUE: 0,
    pickle.NEWFALSE: 0,
    pickle.EMPTY_TUPLE: 0,
    pickle.EMPTY_LIST: 0,
    pickle.EMPTY_DICT: 0,
    pickle.EMPTY_SET: 0,
    pickle.BININT1: 1,
    pickle.BININT2: 2,
    pickle.BININT: 4,
    pickle.BINFLOAT: 8,
    pickle.EXT1: 1,  # refused by name when it is loaded
    pickle.EXT2: 2,
    pickle.EXT4: 4,
}
_COUNTED: Final = {  # leaves whose length, in so many bytes, comes first
    pickle.SHORT_BINSTRING: "<B",
    pickle.SHORT_BINBYTES: "<B",
    pickle.SHORT_BINUNICODE: "<B",
    pickle.LONG1: "<B",
    pickle.LONG4: "<I",
    pickle.BINSTRING: "<I",
    pickle.BINBYTES: "<I",
    pickle.BINUNICODE: "<I",
    pickle.BINBYTES8: "<Q",
    pickle.BINUNICODE8: "<Q",
    pickle.BYTEARRAY8: "<Q",
}
_LINES: Final = (pickle.INT, pickle.LONG, pickle.FLOAT, pickle.STRING, pickle.UNICODE, pickle.PERSID)
_TEXTS: Final = (pickle.STRING, pickle.UNICODE, pickle.PERSID)
_INTEGERS: Final = (pickle.LONG1, pickle.LONG4)
_POPS: Final = {  # how many values an opcode takes, and whether it leaves one of its own
    pickle.REDUCE: (2, True),
    pickle.NEWOBJ: (2, True),
    pickle.NEWOBJ_EX: (3, True),
    pickle.STACK_GLOBAL: (2, True),
    pickle.BINPERSID: (1, True),
    pickle.BUILD: (1, False),
    pickle.APPEND: (1, False),
}


def check_opcodes(data: bytes) -> None:
    """Raise RefusedPickleError where loading ``data`` would cost more than its size allows, or cannot succeed."""
    try:
        _Walk(data).run()
    except (IndexError, KeyError, struct.error, ValueError) as error:
        raise RefusedPickleError("a damaged pickle (its opcodes do not fit together)") from error


class _Walk:
    """The stack machine of pickle, with the cost of hashing a value in the place of the value."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0
        self._stack: list[int] = []
        self._below: list[list[int]] = []
        self._memo = array("H")  # costs of hashing, at most _MAX_HASH + 1; _NO_ENTRY where there is none
        self._num_memo = 0
        self._num_bytes = 0
        self._num_hashes = 0
        self._num_ops = 0
        self._max_bytes = _OBJECT_BYTES[0] + _OBJECT_BYTES[1] * len(data)
        self._max_hashes = _HASHES[0] + _HASHES[1] * len(data)
        self._steps = self._handlers()

    def run(self) -> None:
        """Follow the opcodes up to STOP."""
        data, steps, sizes = self._data, self._steps, _SIZES
        while True:
            op = data[self._at : self._at + 1]
            self._at += 1
            if op == pickle.STOP:
                self._stack.pop()
                return
            step = steps.get(op)
            if step is None:
                raise RefusedPickleError(f"a damaged pickle (opcode {op!r})" if op else "a damaged pickle (cut short)")
            self._num_ops += 1
            step()
            if op in sizes:
                self._num_bytes += sizes[op]
            if self._num_bytes > self._max_bytes:
                raise RefusedPickleError(f"a pickle of more than {self._max_bytes >> 20} MB of objects")

    def _handlers(self) -> dict[bytes, Callable[[], None]]:
        steps: dict[bytes, Callable[[], None]] = {
            pickle.PROTO: lambda: self._skip(1),
            pickle.FRAME: self._frame,
            pickle.GLOBAL: self._global,
            pickle.INST: self._inst,
            pickle.MARK: self._mark,
            pickle.POP: self._pop,
            pickle.POP_MARK: lambda: self._drop(self._since_mark()),
            pickle.DUP: lambda: self._push(self._stack[-1]),
            pickle.OBJ: self._from_mark,
            pickle.LIST: self._from_mark,
            pickle.APPENDS: lambda: self._drop(self._since_mark()),
            pickle.TUPLE: lambda: self._tuple(self._since_mark()),
            pickle.TUPLE1: lambda: self._tuple(self._take(1)),
            pickle.TUPLE2: lambda: self._tuple(self._take(2)),
            pickle.TUPLE3: lambda: self._tuple(self._take(3)),
            pickle.DICT: self._dict,
            pickle.SETITEM: lambda: self._hash(self._take(2)[:1]),
            pickle.SETITEMS: lambda: self._hash(self._since_mark()[::2]),
            pickle.ADDITEMS: lambda: self._hash(self._since_mark()),
            pickle.FROZENSET: self._frozenset,
            pickle.GET: lambda: self._get(self._number()),
            pickle.BINGET: lambda: self._get(self._unpack("<B")),
            pickle.LONG_BINGET: lambda: self._get(self._unpack("<I")),
            pickle.PUT: lambda: self._put(self._number()),
            pickle.BINPUT: lambda: self._put(self._unpack("<B")),
            pickle.LONG_BINPUT: lambda: self._put(self._unpack("<I")),
            pickle.MEMOIZE: lambda: self._put(self._num_memo),
        }
        for op, num in _FIXED.items():
            steps[op] = lambda num=num: self._leaf(num)  # type: ignore[misc]
        for op, layout in _COUNTED.items():
            steps[op] = lambda op=op, layout=layout: self._counted(op, layout)  # type: ignore[misc]
        for op in _LINES:
            steps[op] = lambda op=op: self._text(op)  # type: ignore[misc]
        for op, (num, leaves) in _POPS.items():
            steps[op] = lambda num=num, leaves=leaves: self._call(num, leaves=leaves)  # type: ignore[misc]
        return steps

    def _skip(self, num: int) -> None:
        if num > len(self._data) - self._at:
            raise RefusedPickleError("a damaged pickle (it names more bytes than it has)")
        self._at += num

    def _unpack(self, layout: str) -> int:
        (value,) = struct.unpack_from(layout, self._data, self._at)
        self._at += struct.calcsize(layout)
        return int(value)

    def _line(self) -> int:
        """Step over a line and return its length."""
        end = self._data.index(b"\n", self._at)
        length, self._at = end - self._at, end + 1
        return length

    def _number(self) -> int:
        start = self._at
        if self._line() > 20:
            raise RefusedPickleError("a damaged pickle (a number of a memo entry)")
        return int(self._data[start : self._at - 1])

    def _push(self, cost: int) -> None:
        self._stack.append(cost)
        self._num_bytes += 8

    def _leaf(self, num: int) -> None:
        self._skip(num)
        self._num_bytes += 32 if num else 8
        self._stack.append(1)

    def _counted(self, op: bytes, layout: str) -> None:
        num = self._unpack(layout)
        if op in _INTEGERS and num > _MAX_INTEGER:
            raise RefusedPickleError(f"a pickle with an integer of {num} bytes")
        self._skip(num)
        self._num_bytes += 64 + num
        self._stack.append(_MAX_HASH + 1 if op in _INTEGERS and num > _MAX_KEY else 1)

    def _text(self, op: bytes) -> None:
        length = self._line()
        if op not in _TEXTS and length > 3 * _MAX_INTEGER:
            raise RefusedPickleError(f"a pickle with a number of {length} characters")
        self._num_bytes += 64 + length
        self._stack.append(_MAX_HASH + 1 if op == pickle.LONG and length > _MAX_KEY_DIGITS else 1)

    def _frame(self) -> None:
        num = self._unpack("<Q")
        if num > len(self._data) - self._at:
            raise RefusedPickleError("a damaged pickle (a frame of more bytes than it has)")

    def _global(self) -> None:
        if max(self._line(), self._line()) > _MAX_LINE:
            raise RefusedPickleError("a damaged pickle (the name of a global)")
        self._push(1)

    def _inst(self) -> None:
        self._global()
        self._stack.pop()
        self._from_mark()

    def _mark(self) -> None:
        self._below.append(self._stack)
        self._stack = []
        self._num_bytes += 8

    def _pop(self) -> None:
        if self._stack:
            self._stack.pop()
        else:
            self._since_mark()

    def _since_mark(self) -> list[int]:
        items, self._stack = self._stack, self._below.pop()
        return items

    def _take(self, num: int) -> list[int]:
        if len(self._stack) < num:
            raise IndexError
        items = self._stack[-num:]
        del self._stack[-num:]
        return items

    def _drop(self, items: list[int]) -> None:
        del items

    def _from_mark(self) -> None:
        self._since_mark()
        self._push(1)

    def _call(self, num: int, *, leaves: bool) -> None:
        self._take(num)
        if leaves:
            self._push(1)

    def _tuple(self, items: list[int]) -> None:
        self._num_bytes += 8 * len(items)
        self._stack.append(min(1 + sum(items), _MAX_HASH + 1))

    def _frozenset(self) -> None:
        items = self._since_mark()
        self._hash(items)
        self._tuple(items)

    def _dict(self) -> None:
        self._hash(self._since_mark()[::2])
        self._push(1)

    def _hash(self, keys: list[int]) -> None:
        """Count what it costs to hash keys of a dict or items of a set."""
        self._num_bytes += 100 * len(keys)  # entries of the table
        if max(keys, default=0) > _MAX_HASH:
            raise RefusedPickleError("a pickle with a key that is too large")
        self._num_hashes += sum(keys)
        if self._num_hashes > self._max_hashes:
            raise RefusedPickleError("a pickle whose keys are too large for its size")

    def _get(self, index: int) -> None:
        cost = self._memo[index] if index >= 0 else _NO_ENTRY
        if cost == _NO_ENTRY:
            raise KeyError(index)
        self._push(cost)

    def _put(self, index: int) -> None:
        if not 0 <= index <= self._num_ops:
            raise RefusedPickleError(f"a damaged pickle (memo entry {index} after {self._num_ops} opcodes)")
        memo = self._memo
        if index >= len(memo):
            memo.extend(array("H", [_NO_ENTRY]) * (index + 1 - len(memo)))
        self._num_memo += memo[index] == _NO_ENTRY
        memo[index] = self._stack[-1]
        self._num_bytes += 16
