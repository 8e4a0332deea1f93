"""Levels, thirds and shares that every part of the reproduction counts with."""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd

from sfm_audit.loaders.arrays import FloatArray

ALPHA: Final = 0.05
THIRDS: Final = ("low", "mid", "high")
TESTS: Final = ("ks", "dap", "sw", "ks_fitted", "ks_norm", "ks_norm_unscaled")
SCALES: Final = ("robust", "plain")


def olsson_accepts(distance: FloatArray) -> bool:
    """Whether the mean distance lies between its first and third quartile (method.md section 8)."""
    first, third = np.quantile(distance, [0.25, 0.75])
    return bool(first <= distance.mean() <= third)


def thirds_of(coverage: pd.Series) -> pd.Series:
    """Name the third of each value by rank: low, mid, high."""
    rank = coverage.rank(method="first") - 1.0
    return (rank * 3.0 / len(coverage)).astype(int).map(dict(enumerate(THIRDS)))


def rejects(frame: pd.DataFrame, column: str) -> pd.Series:
    """Return, per row, whether a p-value is below `ALPHA` or a verdict is ``rejected``."""
    values = frame[column]
    if column.startswith("verdict") or column == "plausible":
        return values == "rejected"
    return values < ALPHA


def chosen(frame: pd.DataFrame, **values: object) -> pd.DataFrame:
    """Return the rows with these values in these columns."""
    for name, value in values.items():
        frame = frame[frame[name] == value]
    return frame


def rates_by_third(frame: pd.DataFrame, column: str) -> tuple[float, float, float]:
    """Share rejected in the low, mid and high third; NaN without rows."""
    low, mid, high = (float(rejects(chosen(frame, third=third), column).mean()) for third in THIRDS)
    return low, mid, high
