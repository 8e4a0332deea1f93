"""What a column of a table may hold before Arrow has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """A column of few different texts: ``names[codes[i]]`` in row i; None there is null."""

    codes: npt.NDArray[Any]
    names: Sequence[str | None]

    def __len__(self) -> int:
        return len(self.codes)


@dataclass(frozen=True, slots=True, eq=False)
class Listed:
    """A column of lists: row i holds ``items[offsets[i]:offsets[i + 1]]``, or null where ``known`` (n,) says so."""

    offsets: npt.NDArray[Any]
    items: Column
    known: npt.NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.offsets) - 1


@dataclass(frozen=True, slots=True, eq=False)
class Structs:
    """A column of structs, field by field."""

    fields: Mapping[str, Column]

    def __len__(self) -> int:
        return len(next(iter(self.fields.values())))


Values = npt.NDArray[Any] | Sequence[Any]
Column = Values | Coded | Listed | Structs
