"""Which p-value does Kolmogorov's distance have when the distribution's parameters were estimated? From a table.

The tables are simulated by ``scripts/make_null_tables.py``; each file says with which seed and how many draws.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, lru_cache
from importlib import resources
from typing import TypeVar

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

# Beyond the last entry log p goes on as in the table between this p and the last.
SLOPE_FROM_P = 1e-3


_Distance = TypeVar("_Distance", float, FloatArray)


class NullTable(StrEnum):
    """The packaged null distributions; the value is the file's name without its ending."""

    KS_FITTED = "null_ks_fitted"
    KS_NORM = "null_ks_norm"


@dataclass(frozen=True, slots=True, eq=False)
class QuantileTable:
    """Upper quantiles of a modified statistic.

    num_values: (R,) ascending, the last is inf.    p: (L,) descending, P(statistic >= quantile).
    quantile: (R, L), ascending along L.
    """

    num_values: FloatArray
    p: FloatArray
    quantile: FloatArray


def modified_normal(distance: _Distance, num_values: int) -> _Distance:
    """Stephens' D (sqrt N - 0.01 + 0.85 / sqrt N), for a normal distribution with estimated mean and sd."""
    root = math.sqrt(num_values)
    return distance * (root - 0.01 + 0.85 / root)


def modified_exponential(distance: _Distance, num_values: int) -> _Distance:
    """Stephens' (D - 0.2 / n) (sqrt n + 0.26 + 0.5 / sqrt n), for an exponential distribution with estimated mean."""
    root = math.sqrt(num_values)
    return (distance - 0.2 / num_values) * (root + 0.26 + 0.5 / root)


def null_p(table: NullTable, statistic: float, num_values: int) -> float:
    """P(modified statistic >= statistic) under the table's null hypothesis.

    Parameters
    ----------
    table : NullTable
    statistic : float
        Modified statistic of that table.
    num_values : int
        Sample size; between tabulated sizes quantiles are linear in 1 / sqrt(N).

    Returns
    -------
    float
        log p is linear in the statistic between entries (and from p = 1 at 0 to the first), linear in its square beyond
        the last; never clipped. NaN where the statistic is NaN or the sample smaller than the table's smallest.
    """
    if math.isnan(statistic) or num_values < load(table).num_values[0]:
        return math.nan
    knots, log_p, slope = _curve(table, num_values)
    if statistic <= knots[-1]:
        return math.exp(float(np.interp(statistic, knots, log_p)))
    return math.exp(float(log_p[-1]) + slope * (statistic**2 - float(knots[-1]) ** 2))


def null_p_of_stack(table: NullTable, statistics: FloatArray, num_values: int) -> FloatArray:
    """Return `null_p` of the statistics (B,) of samples of one size."""
    if num_values < load(table).num_values[0]:
        return np.full(statistics.shape, math.nan)
    knots, log_p, slope = _curve(table, num_values)
    beyond = log_p[-1] + slope * (statistics**2 - knots[-1] ** 2)
    return np.exp(np.where(statistics <= knots[-1], np.interp(statistics, knots, log_p), beyond))


@cache
def load(table: NullTable) -> QuantileTable:
    """Read a packaged table. After the comments: p of each column, then N and its quantiles."""
    text = (resources.files("sfm_audit.audit.normality") / f"{table.value}.csv").read_text(encoding="ascii")
    body = np.loadtxt(io.StringIO(text), delimiter=",", dtype=np.float64, comments="#")
    return QuantileTable(num_values=body[1:, 0], p=body[0, 1:], quantile=body[1:, 1:])


@lru_cache(maxsize=1024)
def _curve(table: NullTable, num_values: int) -> tuple[FloatArray, FloatArray, float]:
    """Knots, log p there, and d log p / d statistic^2 beyond the last, for one sample size."""
    data = load(table)
    above = int(np.searchsorted(data.num_values, num_values))
    quantile = data.quantile[above]
    if data.num_values[above] != num_values:
        inverse_root = 1.0 / np.sqrt(data.num_values)
        share = (num_values**-0.5 - inverse_root[above]) / (inverse_root[above - 1] - inverse_root[above])
        quantile = share * data.quantile[above - 1] + (1.0 - share) * quantile
    log_p = np.log(data.p)
    start = int(np.argmin(np.abs(data.p - SLOPE_FROM_P)))
    slope = (log_p[-1] - log_p[start]) / (quantile[-1] ** 2 - quantile[start] ** 2)
    return np.concatenate(([0.0], quantile)), np.concatenate(([0.0], log_p)), float(slope)
