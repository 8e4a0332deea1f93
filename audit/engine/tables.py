"""From columns to the tables of one model."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sfm_audit.audit.decision.decisions import MEMBERS, Decisions
from sfm_audit.audit.decision.judged import VERDICTS
from sfm_audit.audit.decision.triage import IMAGE_COLUMNS
from sfm_audit.audit.engine.image_table import KnownImages
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg
from sfm_audit.audit.table import ColumnGroup, build_table, empty_table, schema
from sfm_audit.audit.table.given import Coded, Column, Listed
from sfm_audit.audit.table.words import VERDICT_ORDER, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import pyarrow as pa

_REJECTED: Final = VERDICT_ORDER[Verdict.REJECTED]


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


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """Of some images what their model needs to know.

    verdicts: (8, n) of the policy, then of each member.    camera_rejected: (n,) by the policy ``camera``.
    num_exact: images whose 2D points are no measurements.
    """

    verdicts: IntArray
    camera_rejected: BoolArray
    num_exact: int

    @classmethod
    def of(cls, decisions: Decisions) -> Said:
        """Return what these decisions say."""
        members = [decisions.members[member] for member in MEMBERS]
        exact = [said.rows for judged in members for said in judged.said if said.code is ReasonCode.EXACT_PROJECTIONS]
        return cls(
            np.stack([decisions.verdict, *(judged.verdict for judged in members)]),
            decisions.under("camera") == _REJECTED,
            len(np.unique(np.concatenate(exact))) if exact else 0,
        )

    @classmethod
    def together(cls, parts: Sequence[Said]) -> Said:
        """Return the same of all images."""
        return cls(
            np.concatenate([part.verdicts for part in parts], axis=1),
            np.concatenate([part.camera_rejected for part in parts]),
            sum(part.num_exact for part in parts),
        )

    @property
    def counts(self) -> dict[str, int]:
        """How many images have which verdict: ``num_<verdict>`` and ``num_<verdict>_<member>``."""
        names = ["", *(f"_{member.short}" for member in MEMBERS)]
        return {
            f"num_{verdict}{name}": int(np.count_nonzero(said == VERDICTS.index(verdict)))
            for name, said in zip(names, self.verdicts, strict=True)
            for verdict in Verdict
        }


@dataclass(frozen=True, slots=True, eq=False)
class ImagesPart:
    """Some images of a model: their rows, ks_p (n,), what was said of them, and rows for `audit.decision.triage`."""

    table: pa.Table
    ks_p: FloatArray
    said: Said
    triage_rows: list[dict[str, Any]]

    @classmethod
    def of(cls, columns: Mapping[str, Column], known: KnownImages, groups: Sequence[ColumnGroup]) -> ImagesPart:
        """Put it together."""
        table = build_table(columns, schema("images", groups))
        ks_p = known.measured.noise.ks_p
        return cls(table, ks_p, Said.of(known.decisions), triage_rows(columns, IMAGE_COLUMNS))


def triage_rows(columns: Mapping[str, Column], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return some columns row by row."""
    return [dict(zip(names, row, strict=True)) for row in zip(*(_values(columns[name]) for name in names), strict=True)]


def _values(column: Any) -> Sequence[Any]:
    if isinstance(column, Listed):
        items, ends = _values(column.items), column.offsets.tolist()
        return [items[start:end] for start, end in itertools.pairwise(ends)]
    if isinstance(column, Coded):
        return [column.names[code] for code in column.codes.tolist()]
    values: Sequence[Any] = column.tolist() if isinstance(column, np.ndarray) else column
    return values


def images_table(parts: Sequence[ImagesPart], groups: Sequence[ColumnGroup] = ()) -> pa.Table:
    """Return the table of images; q-values need all of a model. groups: columns that only some runs have."""
    if not sum(part.table.num_rows for part in parts):
        return empty_table("images", groups)
    import pyarrow as pa  # noqa: PLC0415 - nothing needs it before a table is made

    tables = [part.table for part in parts]
    table = tables[0] if len(tables) == 1 else pa.concat_tables(tables).combine_chunks()
    at = table.column_names.index("ks_q")
    field = table.schema.field(at)
    q = benjamini_hochberg(np.concatenate([part.ks_p for part in parts]))
    return table.set_column(at, field, build_table({"ks_q": q}, pa.schema([field])).column(0))
