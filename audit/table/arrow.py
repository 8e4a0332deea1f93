"""How do numpy arrays become an Arrow table without importing pandas? From buffers.

``pa.array`` and ``pa.table`` import pandas on first use (half a second of every worker process), arrays that are
built from buffers do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """A column of few different texts: ``names[codes[i]]`` in row i; ``codes`` are int32."""

    codes: npt.NDArray[np.int32]
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.codes)


_FLOATS: Final = frozenset({float, np.float64, type(None)})
Values = npt.NDArray[Any] | Sequence[Any]


def build_table(columns: Mapping[str, Values | Coded], wanted: pa.Schema) -> pa.Table:
    """Build an Arrow table of a given schema.

    Parameters
    ----------
    columns : one entry per field of the schema, all of one length. Numbers and booleans: an array, a masked array or
        a sequence that may hold None. Text: a sequence of str or None; dictionaries of text: `Coded`. Lists: a sequence
        of sequences or None; elements of a list of structs are objects with the struct's fields as attributes.
    wanted : the schema, for instance ``audit.table.schema("images")``

    Returns
    -------
    pa.Table
        NaN and infinities (in float columns, not inside lists), None and masked values are null.

    Raises
    ------
    ValueError
        The columns are not exactly those of the schema, differ in length, or a number does not fit its type.
    TypeError
        A column's values are of another kind than its type, such as floats for a count.
    """
    missing = [name for name in wanted.names if name not in columns]
    unknown = [name for name in columns if name not in wanted.names]
    if missing or unknown:
        raise ValueError(f"columns do not match the schema: missing {missing}, unknown {unknown}")
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns differ in length: {lengths}")
    arrays = [_build_column(columns[field.name], field) for field in wanted]
    return pa.Table.from_arrays(arrays, schema=wanted)


def _build_column(values: Values | Coded, field: pa.Field[Any]) -> pa.Array[Any]:
    try:
        return _coded_array(values, field.type) if isinstance(values, Coded) else _build_array(values, field.type)
    except (TypeError, ValueError) as error:
        raise type(error)(f"column {field.name}: {error}") from error


def _build_array(values: Values, kind: pa.DataType) -> pa.Array[Any]:
    if pa.types.is_string(kind):
        return _text_array(values)
    if pa.types.is_list(kind):
        return _list_array(values, kind)
    if pa.types.is_struct(kind):
        return _struct_array(values, kind)
    return _number_array(values, kind)


def _number_array(values: Values, kind: pa.DataType) -> pa.Array[Any]:
    dtype = np.dtype(str(kind))
    array, valid = _split_missing(values, dtype)
    if len(array) and array.dtype.kind not in {"f": "fiu", "b": "b"}.get(dtype.kind, "iu"):
        raise TypeError(f"expected {kind}, found {array.dtype}")
    if dtype.kind in "iu" and valid.any():
        used = array[valid]
        if int(used.min()) != int(used.min().astype(dtype)) or int(used.max()) != int(used.max().astype(dtype)):
            raise ValueError(f"a value does not fit {kind}: {used.min()} .. {used.max()}")
    if dtype.kind == "f":
        valid = valid & np.isfinite(array.astype(dtype))  # a table never holds an infinity
    data = _pack_bits(array.astype(bool)) if dtype.kind == "b" else _buffer(array.astype(dtype))
    return pa.Array.from_buffers(kind, len(array), [_validity(valid), data])


def _split_missing(values: Values, dtype: np.dtype[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Return plain values with zeros where they are missing, and which of them are there."""
    if isinstance(values, np.ma.MaskedArray):
        return values.filled(0), ~np.ma.getmaskarray(values)
    if isinstance(values, np.ndarray) and values.dtype != object:
        return values, np.ones(len(values), dtype=bool)
    if dtype.kind == "f" and _FLOATS.issuperset(map(type, values)):
        return np.array(values, dtype=np.float64), np.ones(len(values), dtype=bool)  # None becomes NaN, which is null
    valid = np.array([value is not None for value in values], dtype=bool)
    blank = dtype.type(0).item()
    plain = np.array([blank if value is None else value for value in values])
    return (plain if len(values) else plain.astype(dtype)), valid


def _text_array(values: Values) -> pa.Array[Any]:
    # a name that is not valid Unicode (lone surrogates) is shown by its code, because Parquet text is UTF-8
    encoded = [None if value is None else str(value).encode(errors="backslashreplace") for value in values]
    offsets = _offsets([0 if text is None else len(text) for text in encoded])
    data = pa.py_buffer(b"".join(text for text in encoded if text is not None))
    valid = np.array([text is not None for text in encoded], dtype=bool)
    return pa.Array.from_buffers(pa.string(), len(encoded), [_validity(valid), offsets, data])


def _coded_array(values: Coded, kind: pa.DataType) -> pa.Array[Any]:
    if not isinstance(kind, pa.DictionaryType):
        raise TypeError(f"expected {kind}, found codes and names")
    buffers = [None, _buffer(values.codes.astype(np.int32, copy=False))]
    return pa.DictionaryArray.from_buffers(kind, len(values), buffers, _text_array(values.names))


def _list_array(values: Values, kind: pa.DataType) -> pa.Array[Any]:
    if not isinstance(kind, pa.ListType):
        raise TypeError(f"expected a list type, found {kind}")
    if pa.types.is_floating(kind.value_type):
        parts = [np.ma.asarray(part, dtype=np.float64) for part in values if part is not None]
        numbers = np.concatenate([np.empty(0), *(part.filled(np.nan) for part in parts)])
        known = ~np.concatenate([np.empty(0, bool), *(np.ma.getmaskarray(part) for part in parts)])
        buffers = [_validity(known), _buffer(numbers)]
        child: pa.Array[Any] = pa.Array.from_buffers(kind.value_type, len(numbers), buffers)
    else:
        items = [item for part in values if part is not None for item in part]
        child = _build_array(items, kind.value_type)
    offsets = _offsets([0 if part is None else len(part) for part in values])
    valid = np.array([part is not None for part in values], dtype=bool)
    return pa.Array.from_buffers(kind, len(values), [_validity(valid), offsets], children=[child])


def _struct_array(values: Values, kind: pa.DataType) -> pa.Array[Any]:
    if not isinstance(kind, pa.StructType):
        raise TypeError(f"expected a struct type, found {kind}")
    fields = [kind.field(i) for i in range(kind.num_fields)]
    children = [_build_column([getattr(item, field.name) for item in values], field) for field in fields]
    return pa.Array.from_buffers(kind, len(values), [None], children=children)


def _offsets(lengths: Sequence[int]) -> pa.Buffer:
    return _buffer(np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int32))


def _validity(valid: npt.NDArray[np.bool_]) -> pa.Buffer | None:
    return None if valid.all() else _pack_bits(valid)


def _pack_bits(bits: npt.NDArray[np.bool_]) -> pa.Buffer:
    return _buffer(np.packbits(bits, bitorder="little"))


def _buffer(array: npt.NDArray[Any]) -> pa.Buffer:
    return pa.py_buffer(np.ascontiguousarray(array).data)
