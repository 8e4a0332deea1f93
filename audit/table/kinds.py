"""The kinds of columns: constructors by type and unit, and the columns that several tables have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sfm_audit.audit.table.types import DOUBLE, FLAG, INT64, TEXT, UINT32, Kind, list_of, struct_of
from sfm_audit.audit.table.words import GROUP_MEANINGS

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Column:
    """One column: ``unit`` is px, deg, count, id, text, bool or 1 (a pure number); ``meaning`` is one line.

    gauge: against what a pose is known, where that matters.
    """

    name: str
    kind: Kind
    unit: str
    meaning: str
    gauge: str = ""

    @property
    def type(self) -> pa.DataType:
        """Its type in Arrow tables."""
        return self.kind.arrow

    @property
    def metadata(self) -> dict[str, str]:
        """What the field of the column says in Parquet files."""
        said = {"unit": self.unit, "meaning": self.meaning}
        return {**said, "gauge": self.gauge} if self.gauge else said


def text(name: str, meaning: str) -> Column:
    """Return a column of a text."""
    return Column(name, TEXT, "text", meaning)


def texts(name: str, meaning: str) -> Column:
    """Return a column of a list of texts."""
    return Column(name, list_of(TEXT), "text", meaning)


def stored_id(name: str, meaning: str) -> Column:
    """Return a column of an id as stored."""
    return Column(name, UINT32, "id", meaning)


def count(name: str, meaning: str) -> Column:
    """Return a column of a count."""
    return Column(name, INT64, "count", meaning)


def flag(name: str, meaning: str) -> Column:
    """Return a column of a truth value."""
    return Column(name, FLAG, "bool", meaning)


def px(name: str, meaning: str) -> Column:
    """Return a column of a length in pixels."""
    return Column(name, DOUBLE, "px", meaning)


def number(name: str, meaning: str) -> Column:
    """Return a column of a pure number."""
    return Column(name, DOUBLE, "1", meaning)


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


REASON_DETAIL: Final = struct_of(code=TEXT, verdict=TEXT, value=DOUBLE, limit=DOUBLE, unit=TEXT, group=TEXT, text=TEXT)
"""One reason: its code, the verdict it speaks for, the number that triggered it, its limit, and the same in words."""

MISFIT_DETAIL: Final = struct_of(
    group=TEXT, status=TEXT, gain=DOUBLE, worth_deg=DOUBLE, worth_centre=DOUBLE, worth_focal_rel=DOUBLE
)
"""One group in the joint test: why it has a q, or why not, BIC gain, and what admitting it would do to the image."""

TESTIMONY: Final = struct_of(witness=TEXT, score=DOUBLE, limit=DOUBLE, q=DOUBLE, unit=TEXT, text=TEXT)
"""What one witness says of an image: it disagrees where score is above limit and q, where it has one, below alpha."""
