"""Which types have columns? By name: Arrow makes them when a table is made, and 27 MB of it are not imported before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Kind:
    """A type of Arrow: a plain one by the name of its function, a list by its element, a struct by its fields."""

    name: str
    element: Kind | None = None
    fields: tuple[tuple[str, Kind], ...] = ()

    @property
    def arrow(self) -> pa.DataType:
        """The type itself."""
        return _made(self)


TEXT: Final = Kind("string")
DOUBLE: Final = Kind("float64")
INT64: Final = Kind("int64")
UINT32: Final = Kind("uint32")
UINT64: Final = Kind("uint64")
FLAG: Final = Kind("bool_")
CODED_TEXT: Final = Kind("dictionary")
"""Of millions of rows with few different texts."""


def list_of(element: Kind) -> Kind:
    """Return the type of a list."""
    return Kind("list_", element)


def struct_of(**fields: Kind) -> Kind:
    """Return the type of a struct with these fields, in this order."""
    return Kind("struct", fields=tuple(fields.items()))


@cache
def _made(kind: Kind) -> pa.DataType:
    import pyarrow as pa  # noqa: PLC0415 - see the head of the file

    if kind.element is not None:
        return pa.list_(pa.field("element", kind.element.arrow))  # Parquet's name for it: read as it was written
    if kind.fields:
        return pa.struct([(name, each.arrow) for name, each in kind.fields])
    if kind == CODED_TEXT:
        return pa.dictionary(pa.int32(), pa.string())
    made: pa.DataType = getattr(pa, kind.name)()
    return made
