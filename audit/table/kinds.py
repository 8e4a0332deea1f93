"""The kinds of columns: constructors by type and unit, and the columns that several tables have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import pyarrow as pa

from sfm_audit.audit.table.words import GROUP_MEANINGS


@dataclass(frozen=True, slots=True)
class Column:
    """One column: ``unit`` is px, deg, count, id, text, bool or 1 (a pure number); ``meaning`` is one line.

    gauge: against what a pose is known, where that matters.
    """

    name: str
    type: pa.DataType
    unit: str
    meaning: str
    gauge: str = ""

    @property
    def metadata(self) -> dict[str, str]:
        """What the field of the column says in Parquet files."""
        said = {"unit": self.unit, "meaning": self.meaning}
        return {**said, "gauge": self.gauge} if self.gauge else said


def text(name: str, meaning: str) -> Column:
    """Return a column of a text."""
    return Column(name, pa.string(), "text", meaning)


def list_of(kind: pa.DataType) -> pa.DataType:
    """Return the type of a list, with the name of its element as Parquet has it."""
    return pa.list_(pa.field("element", kind))  # Parquet's name for it: what is read equals what was written


def texts(name: str, meaning: str) -> Column:
    """Return a column of a list of texts."""
    return Column(name, list_of(pa.string()), "text", meaning)


def stored_id(name: str, meaning: str) -> Column:
    """Return a column of an id as stored."""
    return Column(name, pa.uint32(), "id", meaning)


def count(name: str, meaning: str) -> Column:
    """Return a column of a count."""
    return Column(name, pa.int64(), "count", meaning)


def flag(name: str, meaning: str) -> Column:
    """Return a column of a truth value."""
    return Column(name, pa.bool_(), "bool", meaning)


def px(name: str, meaning: str) -> Column:
    """Return a column of a length in pixels."""
    return Column(name, pa.float64(), "px", meaning)


def number(name: str, meaning: str) -> Column:
    """Return a column of a pure number."""
    return Column(name, pa.float64(), "1", meaning)


def misfit_groups() -> tuple[Column, ...]:
    """Return p, px and rank of every group, on the model as it stands."""
    out = []
    for group, words in GROUP_MEANINGS.items():
        out += [
            number(f"misfit_{group}_p", f"p-value of the score test for {words}, on the model as it stands"),
            px(f"misfit_{group}_px", f"RMS length of the field of {words} in the residuals, cleaned of noise"),
            count(f"misfit_{group}_rank", "free columns of the group; 0: the camera model has it already"),
        ]
    return tuple(out)


def misfit() -> tuple[Column, ...]:
    """Return the groups, the named cause with its effect, and the advice."""
    return (
        *misfit_groups(),
        text("misfit_group", "named cause among the significant groups; for images of the joint test"),
        px("misfit_px", "effect of misfit_group"),
        number("misfit_q", "q-value of misfit_group: Holm over the groups, Benjamini-Hochberg over the model"),
        text("advised_camera_model", "smallest COLMAP model that holds what was found, or none: and what it is"),
    )


REASON_DETAIL: Final = pa.struct(
    [
        ("code", pa.string()),
        ("verdict", pa.string()),
        ("value", pa.float64()),
        ("limit", pa.float64()),
        ("unit", pa.string()),
        ("group", pa.string()),
        ("text", pa.string()),
    ]
)
"""One reason: its code, the verdict it speaks for, the number that triggered it, its limit, and the same in words."""

MISFIT_DETAIL: Final = pa.struct(
    [
        ("group", pa.string()),
        ("status", pa.string()),
        ("gain", pa.float64()),
        ("worth_deg", pa.float64()),
        ("worth_centre", pa.float64()),
        ("worth_focal_rel", pa.float64()),
    ]
)
"""One group in the joint test: why it has a q, or why not, BIC gain, and what admitting it would do to the image."""

TESTIMONY: Final = pa.struct(
    [
        ("witness", pa.string()),
        ("score", pa.float64()),
        ("limit", pa.float64()),
        ("q", pa.float64()),
        ("unit", pa.string()),
        ("text", pa.string()),
    ]
)
"""What one witness says of an image: it disagrees where score is above limit and q, where it has one, below alpha."""

CODED_TEXT: Final = pa.dictionary(pa.int32(), pa.string())  # millions of rows, few different texts
