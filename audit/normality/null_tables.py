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
from typing import Any, TypeVar

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray

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


def modified_normal(distance: _Distance, num_values: int | IntArray) -> _Distance:
    """Stephens' D (sqrt N - 0.01 + 0.85 / sqrt N), for a normal distribution with estimated mean and sd."""
    root: Any = num_values**0.5
    modified: _Distance = distance * (root - 0.01 + 0.85 / root)
    return modified


def modified_exponential(distance: _Distance, num_values: int | IntArray) -> _Distance:
    """Stephens' (D - 0.2 / n) (sqrt n + 0.26 + 0.5 / sqrt n), for an exponential distribution with estimated mean."""
    root: Any = num_values**0.5
    modified: _Distance = (distance - 0.2 / num_values) * (root + 0.26 + 0.5 / root)
    return modified


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


def null_p_of(table: NullTable, statistics: FloatArray, num_values: IntArray) -> FloatArray:
    """Return `null_p` of the statistics (B,) of samples of so many values (B,)."""
    data = load(table)
    log_p = np.concatenate(([0.0], np.log(data.p)))
    above = np.searchsorted(data.num_values, num_values)
    inverse_root = 1.0 / np.sqrt(data.num_values)
    below = np.maximum(above - 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (num_values**-0.5 - inverse_root[above]) / (inverse_root[below] - inverse_root[above])
    share = np.where((data.num_values[above] == num_values) | (above == 0), 0.0, share)[:, None]
    knots = np.zeros((len(statistics), len(log_p)))
    knots[:, 1:] = share * data.quantile[below] + (1.0 - share) * data.quantile[above]
    cell = np.clip((knots <= statistics[:, None]).sum(axis=1) - 1, 0, len(log_p) - 2)
    left, right = np.take_along_axis(knots, np.stack([cell, cell + 1], axis=1), axis=1).T
    slope = (log_p[cell + 1] - log_p[cell]) / (right - left)
    inside = log_p[cell] + slope * np.maximum(statistics - left, 0.0)
    end, start = knots[:, -1], int(np.argmin(np.abs(data.p - SLOPE_FROM_P))) + 1
    slope = (log_p[-1] - log_p[start]) / (end**2 - knots[:, start] ** 2)
    p = np.exp(np.where(statistics <= end, inside, log_p[-1] + slope * (statistics**2 - end**2)))
    return np.where((num_values < data.num_values[0]) | np.isnan(statistics), math.nan, p)


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
