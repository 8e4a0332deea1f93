"""Reads pickles from untrusted sources without running anything that they name.

An allowlist of globals is not enough, because numpy's own are not safe: ``dtype.__setstate__`` accepts any flags, and
an object array whose dtype claims to hold no objects takes its pointers from the file. So no callable of numpy is ever
called with what the pickle says. Each allowed global is replaced by an inert stand-in that only records its arguments;
arrays, dtypes and scalars are made from these records afterwards, by code that checks every field.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sfm_audit.loaders.scene_info.pickle_walk import RefusedPickleError, check_opcodes

Array = npt.NDArray[Any]
OLD_CORE: Final = "numpy.core"  # what NumPy 1 wrote, and what every version reads
NEW_CORE: Final = "numpy._core"

_STEPS: Final = (100_000, 8)  # values looked at: this many, and so many per byte of the file
_ARRAY_BYTES: Final = (4 << 20, 4)  # of all arrays, likewise
_MAX_DEPTH: Final = 64
_MAX_DIMENSIONS: Final = 32
_DTYPE: Final = re.compile(r"(?P<order>[<>=|]?)(?P<code>b1|[iu][1248]|f[248]|c8|c16|[SU][1-9][0-9]{0,8}|O8?)")
_LEAVES: Final = frozenset({type(None), bool, int, float, str, bytes, bytearray})


@dataclass(frozen=True, slots=True)
class InertPickle:
    """What a pickle holds: plain containers and numpy arrays.

    protocol: as written.    numpy_core: the package that it names for numpy's functions, `OLD_CORE` where it has none.
    """

    value: Any
    protocol: int
    numpy_core: str


def load_inert(data: bytes) -> InertPickle:
    """Read a pickle without running anything in it.

    Allowed are None, numbers, str, bytes, list, tuple, dict, set, frozenset, and numpy arrays, dtypes and scalars of
    bool, integer, float, complex, text, bytes or object type.

    Raises
    ------
    RefusedPickleError
        Anything else, the global that it asks for named; damaged pickles.
    """
    check_opcodes(data)
    unpickler = _Unpickler(io.BytesIO(data))
    try:
        loaded = unpickler.load()
        core = unpickler.numpy_core or OLD_CORE
        del unpickler  # with its memo, which holds every object
        value = _Resolver(len(data)).resolve(loaded)
    except RefusedPickleError:
        raise
    except (
        pickle.UnpicklingError,
        EOFError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        OverflowError,
        MemoryError,
        RecursionError,
        ImportError,
    ) as error:  # the kinds that Python's documentation names for damaged pickles
        raise RefusedPickleError(f"a damaged pickle ({' '.join(str(error).split())[:120]})") from error
    protocol = data[1] if data[:1] == pickle.PROTO else 0
    return InertPickle(value, protocol, core)


@dataclass(slots=True, eq=False)
class _Note:
    """A recorded call: the global, its arguments, and the state that was set afterwards. Nothing was executed."""

    call: str
    args: tuple[Any, ...]
    state: Any = None

    def __setstate__(self, state: Any) -> None:
        if self.state is not None or self.call not in {"_reconstruct", "dtype"}:
            raise RefusedPickleError(f"a pickle that sets the state of numpy's {self.call} where no array needs it")
        self.state = state

    def forget(self) -> None:
        """Let go of what was recorded, once the object that it describes is made: it would be in memory twice."""
        self.args, self.state = (), None


class _Global:
    """Stand-in for an allowed global: calling it records the call; its attributes can be neither read nor set."""

    __slots__ = ("_name",)
    _name: str

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __call__(self, *args: Any) -> _Note:
        if object.__getattribute__(self, "_name") == "ndarray":
            raise RefusedPickleError("a pickle that calls numpy.ndarray itself")
        return _Note(object.__getattribute__(self, "_name"), args)

    def __getattribute__(self, name: str) -> Any:
        if name in {"__setstate__", "__class__"}:
            return object.__getattribute__(self, name)
        raise RefusedPickleError(f"a pickle that reaches for the attribute {name!r} of a function")

    def __setattr__(self, name: str, value: Any) -> None:
        raise RefusedPickleError(f"a pickle that sets the attribute {name!r} of a function")

    def __setstate__(self, state: Any) -> None:
        raise RefusedPickleError("a pickle that sets the state of a function")


_NUMPY_FUNCTIONS: Final = {
    "multiarray": ("_reconstruct", "scalar"),
    "numeric": ("_frombuffer",),
}
_ALLOWED: Final[dict[tuple[str, str], _Global]] = {
    ("numpy", "ndarray"): _Global("ndarray"),
    ("numpy", "dtype"): _Global("dtype"),
    ("_codecs", "encode"): _Global("encode"),  # how protocols 0 to 2 write bytes
    **{
        (module, name): _Global(name)
        for module in ("builtins", "__builtin__")
        for name in ("set", "frozenset", "bytes")  # and no bytes at all
    },
    **{
        (f"{core}.{module}", name): _Global(name)
        for core in (OLD_CORE, NEW_CORE)
        for module, names in _NUMPY_FUNCTIONS.items()
        for name in names
    },
}
_NDARRAY: Final = _ALLOWED["numpy", "ndarray"]


class _Unpickler(pickle.Unpickler):
    """Finds stand-ins only; extension codes come through here as well, persistent ids are refused by the base class."""

    numpy_core: str | None = None

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        found = _ALLOWED.get((module_name, global_name))
        if found is None:
            name = f"{module_name}.{global_name}"
            raise RefusedPickleError(f"a pickle that asks for {name!r}, which may run code")
        core = module_name.rpartition(".")[0]
        if core in {OLD_CORE, NEW_CORE}:
            self.numpy_core = core
        return found


class _Resolver:
    """Makes arrays from recorded calls, in new containers; objects that the pickle shares stay shared."""

    def __init__(self, num_bytes: int) -> None:
        self._steps_left = _STEPS[0] + _STEPS[1] * num_bytes
        self._bytes_left = _ARRAY_BYTES[0] + _ARRAY_BYTES[1] * num_bytes
        self._done: dict[int, Any] = {}
        self._open: set[int] = set()

    def resolve(self, value: Any, depth: int = 0) -> Any:
        """Return ``value`` with every note in it replaced by the array, dtype or scalar that it describes."""
        kind = type(value)
        self._steps_left -= 1
        if self._steps_left < 0:
            raise RefusedPickleError("a pickle that names the same objects too often for its size")
        if kind in _LEAVES:
            return value
        if id(value) in self._done:
            return self._done[id(value)]
        if id(value) in self._open:
            raise RefusedPickleError("a pickle of a container that holds itself")
        if depth >= _MAX_DEPTH:
            raise RefusedPickleError(f"a pickle of containers nested more than {_MAX_DEPTH} deep")
        self._open.add(id(value))
        out = self._made(value, depth + 1)
        self._open.discard(id(value))
        self._done[id(value)] = out
        return out

    def _made(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if kind in {list, tuple, set, frozenset}:
            return kind([self.resolve(item, depth) for item in value])
        if kind is dict:
            return {self.resolve(key, depth): self.resolve(item, depth) for key, item in value.items()}
        if kind is _Note:
            make: Callable[[_Note, int], Any] = getattr(self, f"_{value.call.lstrip('_')}")
            made = make(value, depth)
            value.forget()
            return made
        raise RefusedPickleError("a pickle that stores a function instead of calling it")

    def _reconstruct(self, note: _Note, depth: int) -> Array:
        """An array: state = (version, shape, dtype, is_fortran, bytes, or the list of objects in C order)."""
        if len(note.args) != 3 or note.args[0] is not _NDARRAY:
            raise RefusedPickleError("a pickle that makes another kind of numpy object than an array")
        if type(note.state) is not tuple or len(note.state) != 5:
            raise RefusedPickleError("a pickle of an array without its content")
        _, shape, dtype_note, is_fortran, content = note.state
        dtype, order = self._dtype_of(dtype_note), "F" if is_fortran is True else "C"
        if dtype.kind != "O":
            return self._array(self.resolve(content, depth), dtype, shape, order)
        if type(content) is not list or len(content) != num_items(shape):
            raise RefusedPickleError("an array of objects with another number of them than its shape says")
        self._take(8 * len(content))
        flat = np.empty(len(content), dtype=object)
        for position, item in enumerate(content):  # one by one: numpy would spread a list over the elements
            flat[position] = self.resolve(item, depth)
        return flat.reshape(shape)

    def _frombuffer(self, note: _Note, depth: int) -> Array:
        """An array of protocol 5: (bytes, dtype, shape, order, and for order K the order of the axes)."""
        del depth
        content, dtype_note, shape, order, *axes = (*note.args, None) if len(note.args) == 4 else note.args
        if order not in {"C", "F", "K"} or len(axes) != 1:
            raise RefusedPickleError("a pickle of an array in an unknown order")
        array = self._array(content, self._dtype_of(dtype_note), shape, "F" if order == "F" else "C")
        return array.transpose(axes[0]) if order == "K" and axes[0] is not None else array

    def _scalar(self, note: _Note, depth: int) -> Any:
        """A numpy scalar: (dtype, bytes)."""
        dtype_note, content = note.args
        return self._array(self.resolve(content, depth), self._dtype_of(dtype_note), (1,), "C")[0]

    def _dtype(self, note: _Note, depth: int) -> np.dtype[Any]:
        """A dtype: (code, align, copy), state (version, byte order, subarray, names, fields, size, align, flags)."""
        del depth
        code = note.args[0] if note.args else None
        dtype = dtype_of_code(code)
        order: Any = code[0] if type(code) is str and code[0] in "<>=|" else "="
        if note.state is not None:
            if type(note.state) is not tuple or len(note.state) < 5 or note.state[2:5] != (None, None, None):
                raise RefusedPickleError("an array of a type with fields")
            order = note.state[1]
        if order not in {"<", ">", "=", "|"}:
            raise RefusedPickleError("an array of an unknown byte order")
        return dtype if dtype.kind == "O" or order in "|=" else dtype.newbyteorder(order)

    def _encode(self, note: _Note, depth: int) -> bytes:
        del depth
        if len(note.args) == 2 and type(note.args[0]) is str and note.args[1] == "latin1":
            return note.args[0].encode("latin1")
        raise RefusedPickleError("a pickle that encodes something else than bytes")

    def _bytes(self, note: _Note, depth: int) -> bytes:
        del depth
        if note.args:
            raise RefusedPickleError("a pickle that makes bytes from something else")
        return b""

    def _set(self, note: _Note, depth: int) -> set[Any]:
        if len(note.args) == 1 and type(note.args[0]) is list:
            return {self.resolve(item, depth) for item in note.args[0]}
        raise RefusedPickleError("a pickle of a set that is no list of items")

    def _frozenset(self, note: _Note, depth: int) -> frozenset[Any]:
        return frozenset(self._set(note, depth))

    def _array(self, content: Any, dtype: np.dtype[Any], shape: Any, order: str) -> Array:
        self._take(len(content) if type(content) in {bytes, bytearray} else 0)
        return array_from_bytes(content, dtype, shape, order)

    def _take(self, num_bytes: int) -> None:
        """Count the bytes of an array: content that many arrays share is in the file only once."""
        self._bytes_left -= num_bytes
        if self._bytes_left < 0:
            raise RefusedPickleError("a pickle whose arrays take more memory than its size allows")

    def _dtype_of(self, note: Any) -> np.dtype[Any]:
        if type(note) is not _Note or note.call != "dtype":
            raise RefusedPickleError("an array whose type is no numpy.dtype")
        dtype: np.dtype[Any] = self.resolve(note)
        return dtype


def dtype_of_code(code: Any) -> np.dtype[Any]:
    """Return the dtype that a code such as ``<f8`` names; RefusedPickleError where it has fields, or is none."""
    match = _DTYPE.fullmatch(code) if type(code) is str else None
    if match is None:
        raise RefusedPickleError(f"an array of the unsupported type {str(code)[:40]!r}")
    return np.dtype("O") if match["code"][0] == "O" else np.dtype(f"{match['order'].replace('|', '')}{match['code']}")


def num_items(shape: Any) -> int:
    """Return how many elements an array of that shape has; RefusedPickleError where it is no shape."""
    is_shape = type(shape) is tuple and len(shape) <= _MAX_DIMENSIONS
    if not is_shape or not all(type(length) is int and 0 <= length < 2**62 for length in shape):
        raise RefusedPickleError("an array of an impossible shape")
    return math.prod(shape)


def array_from_bytes(content: Any, dtype: np.dtype[Any], shape: Any, order: str) -> Array:
    """Return a writable array of a type without objects; RefusedPickleError where content, type and shape disagree."""
    if dtype.hasobject or dtype.itemsize == 0 or type(content) not in {bytes, bytearray, memoryview}:
        raise RefusedPickleError("an array whose content does not fit its type")
    if num_items(shape) * dtype.itemsize != len(content):
        raise RefusedPickleError(f"an array of {num_items(shape)} elements with {len(content)} bytes of content")
    if dtype.kind == "U" and len(content):
        codes = np.frombuffer(content, dtype=np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if codes.max() > 0x10FFFF:
            raise RefusedPickleError("an array of text with codes that are no characters")
    flat = np.frombuffer(content, dtype=dtype).copy()
    return flat.reshape(shape, order="F" if order == "F" else "C")
