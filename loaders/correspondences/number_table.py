"""Tables of numbers by column name, CSV or Parquet, where every cell must hold a finite number.

What a file states about itself (such as an image's size) stands in a CSV file as ``key=value`` in comment lines above
the line of column names, in a Parquet file as key and value of the schema's metadata. Files are read in pieces: in
memory the numbers lie once, and of the file a piece.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextStream, repr_token

if TYPE_CHECKING:
    import pyarrow.parquet as pq

Groups = Sequence[tuple[str, ...]]

_BATCH_CELLS: Final = 1 << 16
_BATCH_ROWS: Final = 1 << 14
_NUMBER_BYTES: Final = (192 << 20, 2)  # of all numbers: this much, and so many times the file
_PIECE_BYTES: Final = 1 << 20  # of a column of a Parquet file
_PARQUET_MAGIC: Final = b"PAR1"
_MAX_FACTS: Final = 1000
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_FACT: Final = re.compile(r"(?<![\w=])([A-Za-z_]\w*)=([^\s,;]+)")
_CSV_ADVICE: Final = "values are separated by commas and have decimal points, the first line holds the names of columns"
_PARQUET_ADVICE: Final = "write the table again"


@dataclass(frozen=True, slots=True, eq=False)
class NumberTable:
    """Columns (n,) by name, all of them finite; n > 0.

    path: as given by the user.          facts: what the file states about itself.
    groups: (n, k) by the names of k columns, as the reader was asked, without those that the file lacks.
    lines: (n,) line number of each row, from 1; None for Parquet.
    header_line: of the column names; None for Parquet.
    """

    path: str
    groups: Mapping[tuple[str, ...], FloatArray]
    facts: Mapping[str, str]
    lines: IntArray | None = None
    header_line: int | None = None

    @property
    def columns(self) -> Mapping[str, FloatArray]:
        """Views of the groups."""
        return {name: values[:, i] for names, values in self.groups.items() for i, name in enumerate(names)}

    @property
    def num(self) -> int:
        """Rows."""
        return len(next(iter(self.groups.values()), ()))

    def header(self) -> Position | None:
        """Where the names of the columns stand."""
        return None if self.header_line is None else Position("line", self.header_line)

    def position(self, row: int) -> Position:
        """Where a row, counted from 0, stands in the file."""
        return Position("row", row + 1) if self.lines is None else Position("line", int(self.lines[row]))

    def at(self, name: str, row: int) -> str:
        """Return the cell as an error message shows it."""
        return f"{name} = {self.columns[name][row]:.10g}"


def read_number_table(path: InputPath, groups: Groups, ignored: Collection[str]) -> NumberTable:
    """Read a CSV or Parquet file; which of the two its first bytes say.

    Memory: the numbers as float64 once, at most 192 MB and twice the file; a table that claims more is refused.

    Parameters
    ----------
    groups : names of columns of numbers; those of one group become one array
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
    table = _read_parquet(path, groups, ignored) if is_parquet else _read_csv(path, groups, ignored)
    for name, values in table.columns.items():
        wrong = np.flatnonzero(~np.isfinite(values))
        if wrong.size:
            row = int(wrong[0])
            wanted = f"a finite number in column {name}"
            raise MalformedFileError(table.path, table.position(row), wanted, f"{values[row]}", "correct that row")
    return table


def _present(groups: Groups, names: Collection[str]) -> list[tuple[str, ...]]:
    """Return the groups without the columns that a file lacks."""
    present = (tuple(name for name in group if name in names) for group in groups)
    return [group for group in present if group]


def _known(groups: Groups) -> list[str]:
    return [name for group in groups for name in group]


def _most_bytes(num_bytes: int) -> int:
    """Bytes that the numbers of a file of ``num_bytes`` may take."""
    return _NUMBER_BYTES[0] + _NUMBER_BYTES[1] * num_bytes


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


def _read_csv(path: InputPath, groups: Groups, ignored: Collection[str]) -> NumberTable:
    with TextStream(path, _CSV_ADVICE) as file:
        return _csv_table(file, groups, ignored)


def _csv_table(file: TextStream, groups: Groups, ignored: Collection[str]) -> NumberTable:
    path = str(file.path)
    records = file.records()
    facts: dict[str, str] = {}
    header_line, header = 0, b""
    for line, record in records:
        if not record.startswith(b"#"):
            header_line, header = line, record
            break
        _add_facts(file, line, record, facts)
    if not header_line:
        raise file.truncated("a line with the names of the columns", "none")
    names = [name.strip() for name in _fields(file, header_line, header)]
    _check_names(path, Position("line", header_line), names, _known(groups), ignored)
    rows = _CsvRows(file, names, _present(groups, names))
    for line, record in records:
        if not record.startswith(b"#"):
            rows.add(line, record)
    rows.take()
    if not rows.lines:
        raise file.truncated("a row below the names of the columns", "none")
    if not file.is_terminated:
        raise file.truncated("a line end after the last row", "none, so its last number may be cut")
    lines = np.frombuffer(rows.lines, dtype=np.int64)
    return NumberTable(path, rows.arrays(), facts, lines, header_line)


@dataclass(slots=True)
class _CsvRows:
    """Rows of a CSV file; cells wait as text until there are enough to be made numbers at once."""

    file: TextStream
    names: list[str]
    groups: list[tuple[str, ...]]
    lines: array[int] = field(default_factory=lambda: array("q"))
    cells: list[str] = field(default_factory=list)
    numbers: list[array[float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.numbers = [array("d") for _ in self.groups]

    def add(self, line: int, record: bytes) -> None:
        """Add a line; raises where it holds another number of values, or a cell no number."""
        fields = _fields(self.file, line, record)
        if len(fields) != len(self.names):
            raise self.file.malformed(line, f"{len(self.names)} values, one per column", f"{len(fields)}")
        by_name = dict(zip(self.names, fields, strict=True))
        for name in (name for group in self.groups for name in group):
            cell = by_name[name].strip()
            if not _NUMBER.fullmatch(cell):
                got = repr_token(cell.encode()) if cell else "an empty cell"
                raise self.file.malformed(line, f"a finite number in column {name}", got)
            self.cells.append(cell)
        self.lines.append(line)
        if len(self.cells) >= _BATCH_CELLS:
            self.take()

    def take(self) -> None:
        """Make the waiting cells numbers."""
        num_columns = sum(len(group) for group in self.groups)
        values = np.array(self.cells, dtype=np.float64).reshape(-1, max(num_columns, 1))
        self.cells.clear()
        start = 0
        for group, numbers in zip(self.groups, self.numbers, strict=True):
            numbers.frombytes(values[:, start : start + len(group)].tobytes())
            start += len(group)
        needed, most = 8 * (num_columns + 1) * len(self.lines), _most_bytes(self.file.num_bytes)
        if needed > most:
            got = f"more than {most} bytes of them in a file of {self.file.num_bytes}"
            raise self.file.malformed(self.lines[-1], "fewer numbers", got)

    def arrays(self) -> dict[tuple[str, ...], FloatArray]:
        """Return the numbers (n, k) of each group."""
        read = zip(self.groups, self.numbers, strict=True)
        return {group: np.frombuffer(numbers).reshape(-1, len(group)) for group, numbers in read}


def _fields(file: TextStream, line: int, record: bytes) -> list[str]:
    """Split one line at its commas; a quoted value may hold commas, but no line end."""
    try:
        return next(csv.reader([record.decode("utf-8")], strict=True))
    except UnicodeDecodeError as error:
        raise file.malformed(line, "text in UTF-8", f"byte 0x{record[error.start]:02x}") from error
    except csv.Error as error:
        raise file.malformed(line, "values separated by commas", f"{repr_token(record)} ({error})") from error


def _add_facts(file: TextStream, line: int, record: bytes, facts: dict[str, str]) -> None:
    """Add the ``key=value`` of a comment above the line of column names."""
    for key, value in _FACT.findall(record.decode("utf-8", errors="backslashreplace")):
        if facts.setdefault(key, value) != value:
            stated, other = (repr_token(f"{key}={each}".encode()).strip("'") for each in (facts[key], value))
            raise file.malformed(line, f"{stated}, as further up", other)
        if len(facts) > _MAX_FACTS:
            raise file.malformed(line, f"at most {_MAX_FACTS} comments of the form key=value", "more")


def _read_parquet(path: InputPath, groups: Groups, ignored: Collection[str]) -> NumberTable:
    import pyarrow as pa  # noqa: PLC0415 - costs what the reader of a CSV file need not pay
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    stream, num_bytes = open_input(path)
    try:
        with stream, pq.ParquetFile(stream, buffer_size=_PIECE_BYTES) as file:
            return _parquet_table(path, file, num_bytes, groups, ignored)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise _damaged(path, " ".join(str(error).split())[:120]) from error


def _damaged(path: InputPath, how: str) -> MalformedFileError:
    return MalformedFileError(str(path), None, "a Parquet file", f"a damaged one ({how})", _PARQUET_ADVICE)


def _parquet_table(
    path: InputPath, file: pq.ParquetFile, num_bytes: int, groups: Groups, ignored: Collection[str]
) -> NumberTable:
    """Read the columns of numbers, one at a time; those of other names must be in ``ignored``."""
    names = list(file.schema_arrow.names)
    stated = file.schema_arrow.metadata or {}
    facts = {_text(key): _text(value) for key, value in stated.items()}
    _check_names(str(path), None, names, _known(groups), ignored)
    present = _present(groups, names)
    _check_size(path, file, sum(len(group) for group in present), num_bytes)
    num = file.metadata.num_rows
    if num == 0:
        raise MalformedFileError(str(path), None, "at least one row", "none", _PARQUET_ADVICE)
    arrays = {group: np.empty((num, len(group))) for group in present}
    for group, values in arrays.items():
        for column, name in enumerate(group):
            start = 0
            for numbers in _numbers(path, file, name):
                if start + len(numbers) > num:
                    break
                values[start : start + len(numbers), column] = numbers
                start += len(numbers)
            else:
                if start == num:
                    continue
            raise _damaged(path, f"column {name} holds another number of rows than {num}")
    return NumberTable(str(path), arrays, facts)


def _check_size(path: InputPath, file: pq.ParquetFile, num_columns: int, num_bytes: int) -> None:
    """Raise where the numbers of the table would take much more memory than the file, as its footer says."""
    metadata = file.metadata
    # not from the columns of a group: pyarrow asks those in a way that ends the process where they are damaged
    groups = (metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups))
    needed = max(8 * metadata.num_rows * max(num_columns, 1), sum(max(size, 0) for size in groups))
    most = _most_bytes(num_bytes)
    if needed > most or metadata.num_rows < 0:
        got = f"{metadata.num_rows} rows, {needed} bytes, in a file of {num_bytes} bytes"
        wanted = f"a table of at most {most} bytes"
        raise MalformedFileError(str(path), None, wanted, got, "split the table, or write it without repeated values")


def _text(value: bytes) -> str:
    return value.decode("utf-8", errors="backslashreplace")


def _numbers(path: InputPath, file: pq.ParquetFile, name: str) -> Iterator[FloatArray]:
    """Yield pieces of one Parquet column as float64; raises where it holds no numbers, or nothing in some row."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    kind = file.schema_arrow.field(name).type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        raise MalformedFileError(str(path), None, f"numbers in column {name}", str(kind), _PARQUET_ADVICE)
    num_before = 0
    for batch in file.iter_batches(_BATCH_ROWS, columns=[name], use_threads=False):
        column = batch.column(0)
        if column.null_count:
            row = num_before + int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0]) + 1
            wanted = f"a finite number in column {name}"
            raise MalformedFileError(str(path), Position("row", row), wanted, "null", "correct that row")
        num_before += len(column)
        yield np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
