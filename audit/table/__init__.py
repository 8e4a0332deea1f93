"""What do the result tables hold? Columns, and the words of the result; all that reports may know of audit."""

from __future__ import annotations

from sfm_audit.audit.table.columns import (
    CALIBRATION,
    CALIBRATION_RESIDUALS,
    CAMERAS,
    IMAGES,
    MODELS,
    OBSERVATIONS,
    TABLES,
    Column,
    ColumnGroup,
    ModelLabels,
    TableName,
    build_table,
    empty_table,
    schema,
)

__all__ = [
    "CALIBRATION",
    "CALIBRATION_RESIDUALS",
    "CAMERAS",
    "IMAGES",
    "MODELS",
    "OBSERVATIONS",
    "TABLES",
    "Column",
    "ColumnGroup",
    "ModelLabels",
    "TableName",
    "build_table",
    "empty_table",
    "schema",
]
