"""Tables of numbers by column name, CSV or Parquet, where every cell must hold a finite number.

What a file states about itself (such as an image's size) stands in a CSV file as ``key=value`` in comment lines above
the line of column names, in a Parquet file as key and value of the schema's metadata.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextFile, read_text, repr_token

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_BATCH_CELLS: Final = 1 << 16
_PARQUET_BYTES: Final = (64 << 20, 32)  # of the numbers in a Parquet file: this much, and so many times the file
_PARQUET_MAGIC: Final = b"PAR1"
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_FACT: Final = re.compile(r"(?<![\w=])([A-Za-z_]\w*)=([^\s,;]+)")
_CSV_ADVICE: Final = "values are separated by commas and have decimal points, the first line holds the names of columns"
_PARQUET_ADVICE: Final = "write the table again"


@dataclass(frozen=True, slots=True, eq=False)
class NumberTable:
    """Columns (n,) by name, all of them finite; n > 0.

    path: as given by the user.          facts: what the file states about itself.
    lines: (n,) line number of each row, from 1; None for Parquet.
    header_line: of the column names; None for Parquet.
    """

    path: str
    columns: Mapping[str, FloatArray]
    facts: Mapping[str, str]
    lines: IntArray | None = None
    header_line: int | None = None

    @property
    def num(self) -> int:
        """Rows."""
        return len(next(iter(self.columns.values())))

    def header(self) -> Position | None:
        """Where the names of the columns stand."""
        return None if self.header_line is None else Position("line", self.header_line)

    def position(self, row: int) -> Position:
        """Where a row, counted from 0, stands in the file."""
        return Position("row", row + 1) if self.lines is None else Position("line", int(self.lines[row]))

    def at(self, name: str, row: int) -> str:
        """Return the cell as an error message shows it."""
        return f"{name} = {self.columns[name][row]:.10g}"


def read_number_table(path: InputPath, known: Collection[str], ignored: Collection[str]) -> NumberTable:
    """Read a CSV or Parquet file; which of the two its first bytes say.

    Parameters
    ----------
    known : names of columns of numbers
    ignored : names of columns that may stand in the file and are not read

    Raises
    ------
    LoadError
        The file cannot be read; has a column of another name, or two of one name; has no row; or a cell holds no
        finite number.
    """
    file, _ = open_input(path, only_head=True)
    with file, reading(path):
        is_parquet = file.read(len(_PARQUET_MAGIC)) == _PARQUET_MAGIC
    table = _read_parquet(path, known, ignored) if is_parquet else _read_csv(path, known, ignored)
    for name, values in table.columns.items():
        wrong = np.flatnonzero(~np.isfinite(values))
        if wrong.size:
            row = int(wrong[0])
            wanted = f"a finite number in column {name}"
            raise MalformedFileError(table.path, table.position(row), wanted, f"{values[row]}", "correct that row")
    return table


def _check_names(
    path: str, where: Position | None, names: list[str], known: Collection[str], ignored: Collection[str]
) -> None:
    """Raise where a column is not known, as a misspelt one would be lost in silence, or stands there twice."""
    for name in names:
        if name not in known and name not in ignored:
            advice = "rename or remove that column; upper and lower case differ"
            got = f"a column {repr_token(name.encode())}"
            raise MalformedFileError(path, where, f"columns among {', '.join([*known, *ignored])}", got, advice)
        if names.count(name) > 1:
            raise MalformedFileError(path, where, "each column once", f"column {name} twice", "remove one of them")


def _read_csv(path: InputPath, known: Collection[str], ignored: Collection[str]) -> NumberTable:
    file = read_text(path, _CSV_ADVICE)
    records = file.records()
    header_line, header = next(records, (0, b""))
    if not header_line:
        raise file.truncated("a line with the names of the columns", "none")
    names = [name.strip() for name in _fields(file, header_line, header)]
    _check_names(str(path), Position("line", header_line), names, known, ignored)
    read = [column for column, name in enumerate(names) if name in known]
    lines = array("q")
    cells: list[str] = []
    values = np.empty((len(file.lines), len(read)))
    num_read = 0
    for line, record in records:
        fields = _fields(file, line, record)
        if len(fields) != len(names):
            raise file.malformed(line, f"{len(names)} values, one per column", f"{len(fields)}")
        for column in read:
            cell = fields[column].strip()
            if not _NUMBER.fullmatch(cell):
                got = repr_token(cell.encode()) if cell else "an empty cell"
                raise file.malformed(line, f"a finite number in column {names[column]}", got)
            cells.append(cell)
        lines.append(line)
        if len(cells) >= _BATCH_CELLS:
            values[num_read : len(lines)] = np.array(cells, dtype=np.float64).reshape(-1, len(read))
            num_read = len(lines)
            cells.clear()
    if not lines:
        raise file.truncated("a row below the names of the columns", "none")
    if not file.is_terminated:
        raise file.truncated("a line end after the last row", "none, so its last number may be cut")
    values[num_read : len(lines)] = np.array(cells, dtype=np.float64).reshape(-1, len(read))
    columns = {names[column]: values[: len(lines), position] for position, column in enumerate(read)}
    facts = _stated_facts(file, header_line)
    return NumberTable(str(path), columns, facts, np.array(lines, dtype=np.int64), header_line)


def _fields(file: TextFile, line: int, record: bytes) -> list[str]:
    """Split one line at its commas; a quoted value may hold commas, but no line end."""
    try:
        return next(csv.reader([record.decode("utf-8")], strict=True))
    except UnicodeDecodeError as error:
        raise file.malformed(line, "text in UTF-8", f"byte 0x{record[error.start]:02x}") from error
    except csv.Error as error:
        raise file.malformed(line, "values separated by commas", f"{repr_token(record)} ({error})") from error


def _stated_facts(file: TextFile, header_line: int) -> dict[str, str]:
    """Return the ``key=value`` of the comments above the line of column names."""
    facts: dict[str, str] = {}
    for line, text in enumerate(file.lines[: header_line - 1], start=1):
        comment = text.decode("utf-8", errors="backslashreplace")
        for key, value in _FACT.findall(comment):
            if facts.setdefault(key, value) != value:
                raise file.malformed(line, f"{key}={facts[key]}, as further up", f"{key}={value}")
    return facts


def _read_parquet(path: InputPath, known: Collection[str], ignored: Collection[str]) -> NumberTable:
    import pyarrow as pa  # noqa: PLC0415 - costs what the reader of a CSV file need not pay
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    stream, num_bytes = open_input(path)
    try:
        with stream:
            return _parquet_table(path, pq.ParquetFile(stream), num_bytes, known, ignored)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        got = " ".join(str(error).split())[:120]
        raise MalformedFileError(
            str(path), None, "a Parquet file", f"a damaged one ({got})", _PARQUET_ADVICE
        ) from error


def _parquet_table(
    path: InputPath, file: pq.ParquetFile, num_bytes: int, known: Collection[str], ignored: Collection[str]
) -> NumberTable:
    """Read the columns of numbers, one at a time; those of other names must be in ``ignored``."""
    names = list(file.schema_arrow.names)
    stated = file.schema_arrow.metadata or {}
    facts = {_text(key): _text(value) for key, value in stated.items()}
    _check_names(str(path), None, names, known, ignored)
    wanted = [name for name in names if name in known]
    _check_size(path, file, len(wanted), num_bytes)
    columns = {name: _numbers(path, name, file.read(columns=[name], use_threads=False)) for name in wanted}
    if file.metadata.num_rows == 0:
        raise MalformedFileError(str(path), None, "at least one row", "none", _PARQUET_ADVICE)
    return NumberTable(str(path), columns, facts)


def _check_size(path: InputPath, file: pq.ParquetFile, num_columns: int, num_bytes: int) -> None:
    """Raise where the numbers of the table would take much more memory than the file, as its footer says."""
    metadata = file.metadata
    chunks = (
        metadata.row_group(group).column(column).total_uncompressed_size
        for group in range(metadata.num_row_groups)
        for column in range(metadata.num_columns)
    )
    needed = max(8 * metadata.num_rows * max(num_columns, 1), sum(max(chunk, 0) for chunk in chunks))
    most = _PARQUET_BYTES[0] + _PARQUET_BYTES[1] * num_bytes
    if needed > most or metadata.num_rows < 0:
        got = f"{metadata.num_rows} rows, {needed} bytes, in a file of {num_bytes} bytes"
        wanted = f"a table of at most {most} bytes"
        raise MalformedFileError(str(path), None, wanted, got, "split the table, or write it without repeated values")


def _text(value: bytes) -> str:
    return value.decode("utf-8", errors="backslashreplace")


def _numbers(path: InputPath, name: str, table: pa.Table) -> FloatArray:
    """Return one Parquet column as float64; raises where it holds no numbers, or nothing in some row."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    column = table.column(name)
    wanted = f"a finite number in column {name}"
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise MalformedFileError(str(path), None, f"numbers in column {name}", str(column.type), _PARQUET_ADVICE)
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0]) + 1
        raise MalformedFileError(str(path), Position("row", row), wanted, "null", "correct that row")
    return np.asarray(column.to_numpy(), dtype=np.float64)
