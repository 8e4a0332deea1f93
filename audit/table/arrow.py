"""How do numpy arrays become an Arrow table without importing pandas? From buffers.

``pa.array`` and ``pa.table`` import pandas on first use (half a second of every worker process), arrays that are
built from buffers do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from sfm_audit.audit.table.given import Coded, Column, Listed, Structs, Values

_FLOATS: Final = frozenset({float, np.float64, type(None)})
_DOUBLE: Final = pa.float64()
_FEW_ROWS: Final = 1 << 11  # 4 MB of the images table: columns of more rows are not copied
_MANY_SCHEMAS: Final = 64
_known_kinds: Final[dict[int, tuple[pa.Schema, list[tuple[str, pa.DataType]]]]] = {}


def build_table(columns: Mapping[str, Column], wanted: pa.Schema) -> pa.Table:
    """Build an Arrow table of a given schema.

    Parameters
    ----------
    columns : one entry per field of the schema, all of one length. Numbers and booleans: an array, a masked array or
        a sequence that may hold None. Text: a sequence of str or None, or `Coded`; dictionaries of text: `Coded`.
        Lists: `Listed`, or a sequence of sequences or None. Structs: `Structs`, or objects with the same attributes.
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
    names = wanted.names  # a new list each time
    missing = [name for name in names if name not in columns]
    unknown = [name for name in columns if name not in set(names)] if len(columns) != len(names) or missing else []
    if missing or unknown:
        raise ValueError(f"columns do not match the schema: missing {missing}, unknown {unknown}")
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns differ in length: {lengths}")
    kinds = _kinds(wanted)
    arrays = _float_arrays(columns, kinds) if next(iter(lengths.values()), 0) <= _FEW_ROWS else {}
    every = [arrays[name] if name in arrays else _build_column(columns[name], name, kind) for name, kind in kinds]
    return pa.Table.from_arrays(every, schema=wanted)


def _kinds(wanted: pa.Schema) -> list[tuple[str, pa.DataType]]:
    """Return names and types of a schema; asked once of each, as schemas are made once."""
    known = _known_kinds.get(id(wanted))
    if known is None or known[0] is not wanted:
        if len(_known_kinds) >= _MANY_SCHEMAS:
            _known_kinds.clear()
        known = _known_kinds[id(wanted)] = wanted, [(field.name, field.type) for field in wanted]
    return known[1]


def _float_arrays(columns: Mapping[str, Column], kinds: Sequence[tuple[str, pa.DataType]]) -> dict[str, pa.Array[Any]]:
    """Return the columns of doubles, without a mask, as pieces of one buffer: few rows are made in one go."""
    of_doubles = [(name, columns[name]) for name, kind in kinds if kind == _DOUBLE]
    found = {
        name: values
        for name, values in of_doubles
        if (type(values) is np.ndarray and values.dtype == np.float64 and values.ndim == 1)
        or (type(values) is list and _FLOATS.issuperset(map(type, values)))
    }
    if not found:
        return {}
    rows = np.array(list(found.values()), dtype=np.float64)  # None becomes NaN, which is null
    known = np.isfinite(rows)  # a table never holds an infinity
    packed = np.packbits(known, axis=1, bitorder="little")
    is_whole: npt.NDArray[np.bool_] = np.asarray(known.all(axis=1))
    bits, data, (width, size, num) = _buffer(packed), _buffer(rows), (packed.shape[1], rows[0].nbytes, rows.shape[1])
    out = {}
    for row, name in enumerate(found):
        valid = None if is_whole[row] else bits.slice(row * width, width)
        out[name] = pa.Array.from_buffers(_DOUBLE, num, [valid, data.slice(row * size, size)])
    return out


def _build_column(values: Column, name: str, kind: pa.DataType) -> pa.Array[Any]:
    try:
        return _build_array(values, kind)
    except (TypeError, ValueError) as error:
        raise type(error)(f"column {name}: {error}") from error


def _build_array(values: Column, kind: pa.DataType) -> pa.Array[Any]:
    if isinstance(values, Coded):
        return _coded_array(values, kind)
    if pa.types.is_list(kind):
        return _list_array(values, kind)
    if pa.types.is_struct(kind):
        return _struct_array(values, kind)
    if isinstance(values, Listed | Structs):
        raise TypeError(f"expected {kind}, found {type(values).__name__}")
    return _text_array(values) if pa.types.is_string(kind) else _number_array(values, kind)


def _number_array(values: Values, kind: pa.DataType) -> pa.Array[Any]:
    dtype = np.dtype(str(kind))
    if type(values) is np.ndarray and values.dtype == dtype:  # no mask, and every number fits
        known = _validity(np.isfinite(values)) if dtype.kind == "f" else None
        data = _pack_bits(values) if dtype.kind == "b" else _buffer(values)
        return pa.Array.from_buffers(kind, len(values), [known, data])
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
    distinct: dict[Any, int] = {}
    codes = [distinct.setdefault(value, len(distinct)) for value in values]
    return _taken(np.array(codes, dtype=np.int64), list(distinct))


def _taken(codes: npt.NDArray[Any], names: Sequence[Any]) -> pa.Array[Any]:
    """Return the text ``names[codes[i]]`` in row i; what is None there is null."""
    # a name that is not valid Unicode (lone surrogates) is shown by its code, because Parquet text is UTF-8
    encoded = [b"" if name is None else str(name).encode(errors="backslashreplace") for name in names]
    lengths = np.array([len(text) for text in encoded], dtype=np.int64)
    data = b"".join(map(encoded.__getitem__, codes.tolist()))
    known = np.array([name is not None for name in names], dtype=bool)
    buffers = [_validity(known[codes]), _offsets(lengths[codes]), pa.py_buffer(data)]
    return pa.Array.from_buffers(pa.string(), len(codes), buffers)


def _coded_array(values: Coded, kind: pa.DataType) -> pa.Array[Any]:
    if pa.types.is_string(kind):
        return _taken(values.codes, values.names)
    if not isinstance(kind, pa.DictionaryType):
        raise TypeError(f"expected {kind}, found codes and names")
    buffers = [None, _buffer(values.codes.astype(np.int32, copy=False))]
    return pa.DictionaryArray.from_buffers(kind, len(values), buffers, _text_array(values.names))


def _list_array(values: Column, kind: pa.DataType) -> pa.Array[Any]:
    if not isinstance(kind, pa.ListType) or isinstance(values, Structs | Coded):
        raise TypeError(f"expected {kind}, found {type(values).__name__}")
    lists = values if isinstance(values, Listed) else _listed(values, is_floats=pa.types.is_floating(kind.value_type))
    known = np.ones(len(lists), dtype=np.bool_) if lists.known is None else lists.known
    is_floats = pa.types.is_floating(kind.value_type)
    child = _floats(lists.items, kind) if is_floats else _build_array(lists.items, kind.value_type)
    buffers = [_validity(known), _buffer(lists.offsets.astype(np.int32))]
    return pa.Array.from_buffers(kind, len(lists), buffers, children=[child])


def _listed(values: Values, *, is_floats: bool) -> Listed:
    """Return a sequence of sequences or None side by side."""
    parts = [part for part in values if part is not None]
    items: Any = [item for part in parts for item in part] if not is_floats else _joined(parts)
    offsets = np.concatenate([[0], np.cumsum([0 if part is None else len(part) for part in values], dtype=np.int64)])
    return Listed(offsets, items, np.array([part is not None for part in values], dtype=np.bool_))


def _joined(parts: Sequence[Any]) -> npt.NDArray[Any]:
    """Return all numbers of lists, masked ones among them."""
    numbers: npt.NDArray[Any] = np.concatenate([np.empty(0), *(np.ma.getdata(np.ma.asarray(each)) for each in parts)])
    return np.ma.masked_array(numbers, np.concatenate([np.empty(0, bool), *map(np.ma.getmaskarray, parts)]))


def _floats(items: Any, kind: pa.ListType[Any]) -> pa.Array[Any]:
    """Return the numbers of lists: NaN stays, masked is null."""
    numbers = np.ma.asarray(items, dtype=np.float64)
    buffers = [_validity(~np.ma.getmaskarray(numbers)), _buffer(numbers.filled(np.nan))]
    return pa.Array.from_buffers(kind.value_type, len(numbers), buffers)


def _struct_array(values: Column, kind: pa.DataType) -> pa.Array[Any]:
    if not isinstance(kind, pa.StructType) or isinstance(values, Listed | Coded):
        raise TypeError(f"expected {kind}, found {type(values).__name__}")
    fields = [kind.field(i) for i in range(kind.num_fields)]
    if isinstance(values, Structs):
        children = [_build_column(values.fields[field.name], field.name, field.type) for field in fields]
    else:
        children = [
            _build_column([getattr(item, field.name) for item in values], field.name, field.type) for field in fields
        ]
    return pa.Array.from_buffers(kind, len(values), [None], children=children)


def _offsets(lengths: Values) -> pa.Buffer:
    return _buffer(np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int32))


def _validity(valid: npt.NDArray[np.bool_]) -> pa.Buffer | None:
    return None if valid.all() else _pack_bits(valid)


def _pack_bits(bits: npt.NDArray[np.bool_]) -> pa.Buffer:
    return _buffer(np.packbits(bits, bitorder="little"))


def _buffer(array: npt.NDArray[Any]) -> pa.Buffer:
    return pa.py_buffer(np.ascontiguousarray(array).data)
