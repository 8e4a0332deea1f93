"""Numbers and tables as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np


def percent(share: float) -> str:
    """One decimal; a dash without trials."""
    return "–" if np.isnan(share) else f"{100 * share:.1f} %"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, first column to the left, the others to the right; ValueError for a row of another width."""
    rows = [*rows]
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"a row has not the {len(header)} columns of {', '.join(header)}")
    lines = ["| " + " | ".join(header) + " |", "|---|" + "---:|" * (len(header) - 1)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])
