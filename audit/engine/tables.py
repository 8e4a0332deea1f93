"""From rows to the tables of one model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from sfm_audit.audit.engine.rows import Row
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg
from sfm_audit.audit.table import ColumnGroup, TableName, build_table, empty_table, schema


@dataclass(frozen=True, slots=True, eq=False)
class ModelAudit:
    """The tables of one model, as written to a run folder: a row per image, per camera, per model.

    observations: a row per inlier; None unless it was asked for.
    """

    images: pa.Table
    cameras: pa.Table
    models: pa.Table
    observations: pa.Table | None = None

    def __repr__(self) -> str:
        return f"<ModelAudit: {', '.join(f'{name} {table.num_rows} rows' for name, table in self.tables.items())}>"

    @property
    def tables(self) -> dict[str, pa.Table]:
        """The tables by name."""
        tables = {"images": self.images, "cameras": self.cameras, "models": self.models}
        return tables if self.observations is None else {**tables, "observations": self.observations}


def images_table(rows: Sequence[Row], groups: Sequence[ColumnGroup] = ()) -> pa.Table:
    """Return the table of images; q-values need all of a model. groups: columns that only some runs have."""
    if rows:
        q = benjamini_hochberg(np.array([row["ks_p"] for row in rows], dtype=np.float64))
        for row, value in zip(rows, q, strict=True):
            row["ks_q"] = value
    return table_of("images", rows, groups)


def table_of(name: TableName, rows: Sequence[Row], groups: Sequence[ColumnGroup] = ()) -> pa.Table:
    """Return the table with these rows."""
    if not rows:
        return empty_table(name, groups)
    return build_table({column: [row[column] for row in rows] for column in rows[0]}, schema(name, groups))
