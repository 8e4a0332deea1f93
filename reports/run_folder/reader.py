"""What does a run folder hold? Its run.json, and rows of its tables, streamed part by part."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from sfm_audit.reports.errors import RunFolderError

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class RunReader:
    """A run folder that is read, not written. info: the content of run.json."""

    folder: Path
    info: dict[str, Any]

    @classmethod
    def open(cls, folder: Path) -> RunReader:
        """Read run.json.

        Raises
        ------
        RunFolderError
            The folder holds no run.
        """
        try:
            info = json.loads((folder / "run.json").read_bytes())
        except (OSError, ValueError) as error:
            raise RunFolderError(folder, "holds no run (run.json)", "name the folder that run -o wrote") from error
        return cls(folder, info)

    def rows(self, table: str, columns: Sequence[str]) -> Iterator[Row]:
        """Yield the rows of a table, one part in memory at a time, in the order of the parts' names."""
        for path in sorted((self.folder / table).glob("part-*.parquet")):
            with pq.ParquetFile(path) as part:
                yield from part.read(columns=list(columns)).to_pylist()
