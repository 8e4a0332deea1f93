"""What does a run folder hold? Its run.json, and rows of its tables, streamed part by part and checked before.

Nothing is read but what the manifest names, and of that only what fits it (docs/decisions/0008-run-folder-checked.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sfm_audit.reports.errors import DamagedRunError, RunFolderError
from sfm_audit.reports.run_folder.manifest import MANIFEST, Manifest
from sfm_audit.reports.run_folder.parts import checked_part, part_path, rows_of, table_of
from sfm_audit.reports.run_folder.record import ModelRecord, RunRecord, old_models, read_run_json

Row = dict[str, Any]
OLD_NOTE = "was written by an older sfm-audit without hashes; only labels and rows of its parts were checked"


REVISED: Final = ("images", "cameras", "models")
"""Tables that a revision may change."""


class Revision(Protocol):
    """What becomes of a run's verdicts under other settings: from the tables of one model to those that are read."""

    def __call__(self, table: str, key: str, read: Callable[[str], pa.Table]) -> pa.Table:
        """Return a table of the model ``key`` as it is to be read; ``read``: its tables as the run wrote them."""


@dataclass(frozen=True, slots=True)
class RunReader:
    """A run folder that is read, not written. info: the content of run.json, checked.    contents: its models.

    note: what a reader should know about how far it could be checked; None for nothing.
    revision: None for the tables as they were written.
    """

    folder: Path
    info: dict[str, Any]
    contents: Manifest | tuple[ModelRecord, ...]
    note: str | None = None
    revision: Revision | None = None

    @classmethod
    def open(cls, folder: Path) -> RunReader:
        """Read run.json and the manifest.

        Raises
        ------
        RunFolderError
            The folder holds no run. DamagedRunError: it holds one that was changed.
        """
        try:
            record = read_run_json(folder)
        except OSError as error:
            raise RunFolderError(folder, "holds no run (run.json)", "name the folder that run -o wrote") from error
        info = record.model_dump(mode="json", exclude={"inputs", "manifest"})
        if _is_old(folder, record):
            return cls(folder, info, old_models(folder, record), OLD_NOTE)
        if record.status == "complete" and record.manifest is None:
            raise DamagedRunError(folder, "its run.json does not say which models it holds")
        return cls(folder, info, Manifest.read(folder, record.manifest if record.status == "complete" else None))

    def revised(self, config: dict[str, Any], revision: Revision, decided_again: str) -> RunReader:
        """Return the run as it is read under other settings; ``decided_again``: which, in words."""
        return replace(self, info={**self.info, "config": config, "decided_again": decided_again}, revision=revision)

    @property
    def num_models(self) -> int:
        """How many models the run holds."""
        return len(self.contents)

    def models(self) -> Iterator[ModelRecord]:
        """Yield what the run folder says of its models, in the order of their keys."""
        return iter(self.contents) if isinstance(self.contents, tuple) else self.contents.models()

    def rows(self, table: str, columns: Sequence[str]) -> Iterator[Row]:
        """Yield the rows of a table, few in memory at a time, in the order of the parts' names.

        Raises
        ------
        DamagedRunError
            A part is not what the run wrote.
        """
        for model in self.models():
            if self.revision is not None and table in REVISED:
                yield from self._revised_rows(table, model, columns)
                continue
            with self._part(table, model) as part:
                yield from rows_of(part, table, columns)

    def parts(self, table: str, columns: Sequence[str]) -> Iterator[tuple[str, list[Row]]]:
        """Yield name and rows of each part, in the order of their names, null where a column is not there.

        Errors as of `rows`.
        """
        blank = dict.fromkeys(columns)
        for model in self.models():
            if self.revision is not None and table in REVISED:
                rows = [blank | row for row in self._revised_rows(table, model, columns)]
            else:
                with self._part(table, model) as part:
                    rows = [blank | row for row in rows_of(part, table, columns)]
            yield part_path(self.folder, table, model.key).name, rows

    def has_part(self, table: str, name: str) -> bool:
        """Whether the run has a part called ``name`` in this table."""
        model = self._find(name.removeprefix("part-").removesuffix(".parquet"))
        if model is None or model.parts:
            return model is not None and table in model.parts
        return part_path(self.folder, table, model.key).exists()

    def rows_of_image(self, table: str, name: str, image_id: int, columns: Sequence[str]) -> pa.Table | None:
        """Return the rows of an image in the part called ``name``; None where the run has no such part.

        Raises
        ------
        DamagedRunError
            It is not what the run wrote.
        """
        model = self._find(name.removeprefix("part-").removesuffix(".parquet"))
        if model is None or not self.has_part(table, name):
            return None
        with self._part(table, model) as part:
            read = part.read(columns=[*columns, "image_id"])
        return read.filter(pa.array(read["image_id"].to_numpy() == image_id))

    def rows_of_camera(self, name: str, camera_id: int, columns: Sequence[str]) -> pa.Table:
        """Return the observations of all images of a camera in the part called ``name``.

        Raises
        ------
        DamagedRunError
            It is not what the run wrote.
        """
        key = name.removeprefix("part-").removesuffix(".parquet")
        model = self._find(key)
        if model is None:
            raise DamagedRunError(self.folder, f"its {MANIFEST} names no part {name}")
        with self._part("images", model) as part:
            images = part.read(columns=["image_id", "camera_id"])
        mine = images["image_id"].to_numpy()[images["camera_id"].to_numpy() == camera_id]
        with self._part("observations", model) as part:
            read = part.read(columns=[*columns, "image_id"])
        return read.filter(pa.array(np.isin(read["image_id"].to_numpy(), mine)))

    def _revised_rows(self, table: str, model: ModelRecord, columns: Sequence[str]) -> list[Row]:
        """Return the rows of a table of one model, revised."""
        if self.revision is None:
            raise ValueError("nothing is revised")

        def read(name: str) -> pa.Table:
            with self._part(name, model) as part:
                return table_of(part, name)

        revised = self.revision(table, model.key, read)
        return revised.select([name for name in columns if name in revised.column_names]).to_pylist()

    def _find(self, key: str) -> ModelRecord | None:
        if isinstance(self.contents, Manifest):
            return self.contents.find(key)
        return next((model for model in self.contents if model.key == key), None)

    @contextmanager
    def _part(self, table: str, model: ModelRecord) -> Iterator[pq.ParquetFile]:
        if model.parts and table not in model.parts:
            raise DamagedRunError(self.folder, f"its {MANIFEST} names no {table} of {model.model_path}")
        with checked_part(self.folder, table, model) as part:
            yield part


def _is_old(folder: Path, record: RunRecord) -> bool:
    return record.manifest is None and record.inputs is not None and not (folder / MANIFEST).exists()
