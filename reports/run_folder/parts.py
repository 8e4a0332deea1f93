"""How is one part of a run read? Only after its bytes, and its columns, are what the run folder says of them."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from sfm_audit.audit.table import TABLES
from sfm_audit.reports.errors import DamagedRunError
from sfm_audit.reports.run_folder.disk import open_plain
from sfm_audit.reports.run_folder.record import ModelRecord, PartRecord

METADATA_KEY: Final = b"sfm_audit"
_IN_MEMORY_BYTES: Final = 32_000_000  # parts up to that size are read once; larger ones once more to hash them
_ROWS_AT_A_TIME: Final = 4096
_LABELS: Final = ("dataset", "scene", "component", "model_path")
_NEVER_NULL: Final[Mapping[str, frozenset[str]]] = {
    "images": frozenset({*_LABELS, "image_id", "image_name"}),
    "cameras": frozenset({*_LABELS, "camera_id", "num_images"}),
    "models": frozenset({*_LABELS, "num_images", "num_accepted", "num_rejected", "num_undetermined"}),
}
_ALWAYS_SAID: Final = frozenset({"code", "text"})  # of a finding, of a reason
_TYPES: Final = {table: {column.name: column.type for column in columns} for table, columns in TABLES.items()}


def part_path(folder: Path, table: str, key: str) -> Path:
    """Return where the part of a model lies."""
    return folder / table / f"part-{key}.parquet"


@contextmanager
def checked_part(folder: Path, table: str, model: ModelRecord) -> Iterator[pq.ParquetFile]:
    """Open the part of a model in a table.

    A model without ``parts`` is one of a run folder that has no hashes: there the part's own metadata must name the
    model, and have as many rows.

    Raises
    ------
    DamagedRunError
        It is not the part that was written: gone, cut short, changed, of another model, a link or no file.
    """
    path = part_path(folder, table, model.key)
    name = f"{table}/{path.name}"
    if (folder / table).is_symlink():
        raise DamagedRunError(folder, f"{table} is a link; a run folder is read without following links")
    try:
        with open_plain(path, follow_links=False) as file, _as_parquet(file, model.parts.get(table)) as part:
            _check_rows(part, file)
            if not model.parts:
                _check_own_words(part, table, model)
            yield part
    except FileNotFoundError as error:
        raise DamagedRunError(folder, f"its part {name} ({_short(model.model_path)}) is gone") from error
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        what = f"its part {name} ({_short(model.model_path)}) is damaged ({_short(str(error))})"
        raise DamagedRunError(folder, what) from error


def part_record(content: pa.Buffer, num_rows: int) -> PartRecord:
    """Return what a manifest says of a part."""
    return PartRecord(rows=num_rows, num_bytes=content.size, sha256=hashlib.sha256(content).hexdigest())


def fits(path: Path, wanted: PartRecord) -> bool:
    """Whether the bytes of a part are those that were written."""
    try:
        with open_plain(path, follow_links=False) as file:
            return _size(file) == wanted.num_bytes and hashlib.file_digest(file, "sha256").hexdigest() == wanted.sha256
    except OSError:
        return False


def rows_of(part: pq.ParquetFile, table: str, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a part, without columns that it lacks, as one of another version may.

    Raises
    ------
    ValueError
        A column is not of its type, or lacks what is never null.
    """
    _check_types(part.schema_arrow, table, columns)
    for batch in part.iter_batches(_ROWS_AT_A_TIME, columns=list(columns)):
        _check_nulls(batch, table)
        yield from batch.to_pylist()


def table_of(part: pq.ParquetFile, table: str) -> pa.Table:
    """Return all rows and columns of a part; errors as of `rows_of`."""
    _check_types(part.schema_arrow, table, part.schema_arrow.names)
    read = part.read()
    for batch in read.to_batches():
        _check_nulls(batch, table)
    return read


def _check_types(found: pa.Schema, table: str, columns: Sequence[str]) -> None:
    types = _TYPES[table]  # type: ignore[index]
    lost = sorted(_NEVER_NULL.get(table, frozenset()).intersection(columns) - set(found.names))
    if lost:
        raise ValueError(f"it has no column {lost[0]}")
    for name in columns:
        if name in types and name in found.names and found.field(name).type != types[name]:
            raise ValueError(f"its column {name} is of type {found.field(name).type}, not {types[name]}")


def _check_nulls(batch: pa.RecordBatch, table: str) -> None:
    for name, values in zip(batch.schema.names, batch.columns, strict=True):
        if (name in _NEVER_NULL.get(table, ()) and values.null_count) or _has_null_elements(values):
            raise ValueError(f"its column {name} has a null where there never is one")


@contextmanager
def _as_parquet(file: io.BufferedReader, wanted: PartRecord | None) -> Iterator[pq.ParquetFile]:
    size = _size(file)
    source: Any = file
    if wanted is not None and size != wanted.num_bytes:
        raise ValueError(f"{size} bytes, not {wanted.num_bytes}")
    if size <= _IN_MEMORY_BYTES:
        content = file.read()
        digest = hashlib.sha256(content)
        source = pa.BufferReader(content)
    elif wanted is not None:
        digest = hashlib.file_digest(file, "sha256")
        file.seek(0)
    if wanted is not None and digest.hexdigest() != wanted.sha256:
        raise ValueError("its bytes are not those that were written")
    with pq.ParquetFile(source) as part:
        if wanted is not None and part.metadata.num_rows != wanted.rows:
            raise ValueError(f"{part.metadata.num_rows} rows, not {wanted.rows}")
        yield part


def _check_rows(part: pq.ParquetFile, file: io.BufferedReader) -> None:
    if part.metadata.num_rows > _size(file):  # no table of ours has rows of less than a byte, a bomb has
        raise ValueError(f"{part.metadata.num_rows} rows in {_size(file)} bytes")


def _check_own_words(part: pq.ParquetFile, table: str, model: ModelRecord) -> None:
    """Compare the part of a run without hashes with what stands in its own metadata."""
    try:
        said = json.loads((part.metadata.metadata or {})[METADATA_KEY])
        labels, counts = said["labels"], said["counts"]
        rows = {"images": counts["num_images"], "models": 1}.get(table, part.metadata.num_rows)
        digest = said["state"]["digest"]
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError("it does not say what it is a part of") from error
    if labels != dict(model.labels) or digest != model.sha256:
        raise ValueError("it is the part of another model, or of another state of it")
    if part.metadata.num_rows != rows:
        raise ValueError(f"{part.metadata.num_rows} rows, not {rows}")


def _has_null_elements(values: pa.Array[Any]) -> bool:
    """Whether a list of texts or of records (reasons, findings) has a null element, or one without code or text."""
    if not pa.types.is_list(values.type) or pa.types.is_floating(values.type.value_type):
        return False
    elements = values.values  # type: ignore[attr-defined] # flatten() imports all of pyarrow.compute
    if elements.null_count:
        return True
    if not pa.types.is_struct(elements.type):
        return False
    names = [elements.type.field(i).name for i in range(elements.type.num_fields)]
    fields = zip(names, elements.flatten(), strict=True)
    return any(name in _ALWAYS_SAID and field.null_count for name, field in fields)


def _size(file: io.BufferedReader) -> int:
    here = file.tell()
    size = file.seek(0, io.SEEK_END)
    file.seek(here)
    return size


def _short(text: str) -> str:
    words = " ".join(text.split())
    return words if len(words) <= 120 else f"{words[:117]}..."
