"""Which numbers does a figure show? Bins, means, quantiles and ticks, the same for SVG and for matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from sfm_audit.audit.table.words import Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.reports.charts.residuals import Residuals

REACH_SD: Final = 5.0  # shown of standardised residuals; what lies beyond is counted in the outermost bars
Z_BINS: Final = 41
RUN_BINS: Final = 40
MAX_STEPS: Final = 400
ARROW_SHARE: Final = 0.08  # of the image's longer side, for a long residual (90th percentile)
MISFIT_GROUPS: Final = ("radial", "tangential", "affine", "principal_point", "rolling_shutter", "smooth")
_MAX_QUANTILES: Final = 250
_CHI2_99: Final = 9.21  # two degrees of freedom
_MAX_TICKS: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class CellMeans:
    """Mean residuals in square cells of the sensor, row by row.

    side_px: of a cell.    shape: rows and columns.    centre_px, mean_px: (rows * columns, 2).    count: observations.
    full: cells with enough of them.    beyond: longer than noise leaves in one cell of a hundred.
    """

    side_px: float
    shape: tuple[int, int]
    centre_px: FloatArray
    mean_px: FloatArray
    count: IntArray
    full: BoolArray
    beyond: BoolArray

    @property
    def length_px(self) -> FloatArray:
        """(rows * columns,) lengths of the means."""
        return np.asarray(np.hypot(*self.mean_px.T))


def cell_means(residuals: Residuals, *, cells: int = 10, min_per_cell: int = 3) -> CellMeans:
    """Return the mean residual of each cell; ``cells`` lie along the longer side."""
    side = max(residuals.size_px) / cells
    columns, rows = (max(1, math.ceil(size / side - 1e-9)) for size in residuals.size_px)
    at = np.clip((residuals.xy_px // side).astype(np.int64), 0, [columns - 1, rows - 1])
    cell = at[:, 1] * columns + at[:, 0]
    count = np.bincount(cell, minlength=rows * columns)
    with np.errstate(invalid="ignore"):
        mean = np.stack(
            [np.bincount(cell, residuals.residual_px[:, i], rows * columns) / count for i in (0, 1)], axis=1
        )
    full = count >= min_per_cell
    centre = np.stack(np.meshgrid((np.arange(columns) + 0.5) * side, (np.arange(rows) + 0.5) * side), -1).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        beyond = full & ((mean**2).sum(axis=1) * count > _CHI2_99 * residuals.sigma_px**2)
    return CellMeans(side, (rows, columns), centre, mean, count, full, beyond)


def magnification(long_px: float, size_px: float) -> float:
    """Return 1, 2 or 5 times a power of ten: by how much to draw ``long_px`` longer on a sensor of ``size_px``."""
    if not long_px > 0:
        return 1.0
    wanted = ARROW_SHARE * size_px / long_px
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted * (1 + 1e-9)) * power)


def evenly(count: int, at_most: int) -> IntArray:
    """Return rows: all, or ``at_most`` of them evenly spaced in their order."""
    if count <= at_most:
        return np.arange(count, dtype=np.int64)
    return np.floor((np.arange(at_most) + 0.5) * count / at_most).astype(np.int64)


def radial_parts(residuals: Residuals) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return radius, radial and tangential part of the residuals, (n,) px each."""
    offset = residuals.xy_px - np.array(residuals.centre_px)
    radius = np.hypot(*offset.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = np.where(radius[:, None] > 0, offset / radius[:, None], 0.0)
    radial = np.einsum("ni,ni->n", unit, residuals.residual_px)
    tangential = unit[:, 0] * residuals.residual_px[:, 1] - unit[:, 1] * residuals.residual_px[:, 0]
    return radius, radial, tangential


def profile(radius: FloatArray, values: FloatArray, bins: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return middle, mean and standard error in bins of equal count."""
    parts = np.array_split(np.argsort(radius, kind="stable"), bins)
    middle = np.array([radius[part].mean() for part in parts])
    mean = np.array([values[part].mean() for part in parts])
    error = np.array([values[part].std(ddof=1) / math.sqrt(len(part)) for part in parts])
    return middle, mean, error


def density(values: FloatArray, edges: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return middles, heights and width of bars; values beyond the edges are counted in the outermost bars."""
    width = float(edges[1] - edges[0])
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return (edges[:-1] + edges[1:]) / 2.0, counts / (values.size * width), width


def normal_density(x: FloatArray) -> FloatArray:
    """Return the density of N(0, 1)."""
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class Quantiles:
    """Quantiles of z over those of N(0, 1), thinned; low and high: 95 % band of each under N(0, 1). (k,) each."""

    normal: FloatArray
    found: FloatArray
    low: FloatArray
    high: FloatArray


def quantiles(z: FloatArray) -> Quantiles:
    """Return what a Q-Q plot of z (any shape, not empty) shows."""
    values = np.sort(z.ravel())
    n = values.size
    rank = _thinned_ranks(n)
    low, high = (
        np.asarray(special.ndtri(special.betaincinv(rank + 1.0, n - rank, p)), dtype=np.float64) for p in (0.025, 0.975)
    )
    return Quantiles(special.ndtri((rank + 0.5) / n), values[rank], low, high)


def _thinned_ranks(n: int) -> IntArray:
    """Ranks 0..n-1: all of the tails, evenly thinned between them."""
    if n <= _MAX_QUANTILES:
        return np.arange(n, dtype=np.int64)
    tail = _MAX_QUANTILES // 8
    inner = np.linspace(tail, n - 1 - tail, _MAX_QUANTILES - 2 * tail).astype(np.int64)
    return np.unique(np.concatenate([np.arange(tail), inner, np.arange(n - tail, n)]))


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """Images per bin and verdict. edges: (bins + 1,).    counts: by verdict (bins,).    shown, missing: images."""

    edges: FloatArray
    counts: Mapping[str, IntArray]
    shown: int
    missing: int


def histogram(values: Any, verdicts: Sequence[str], *, log: bool) -> Histogram | None:
    """Return the histogram of a number over images, None where no image has it; outermost bars hold what is beyond."""
    number = np.asarray(values, dtype=np.float64)
    verdict = np.asarray(verdicts, dtype=object)
    usable = np.isfinite(number) & (number > 0 if log else True)
    if not usable.any():
        return None
    low, high = bulk(number[usable], log=log)
    edges = np.geomspace(low, high, RUN_BINS + 1) if log else np.linspace(low, high, RUN_BINS + 1)
    shown = np.clip(number, edges[0], edges[-1])
    counts = {str(name): np.histogram(shown[usable & (verdict == name)], edges)[0] for name in Verdict}
    return Histogram(edges, counts, int(usable.sum()), int(np.count_nonzero(~usable)))


def bulk(values: FloatArray, *, log: bool) -> tuple[float, float]:
    """Return the range of all but the outer half percent at either side; never empty."""
    low, high = (float(v) for v in np.quantile(values, [0.005, 0.995]))
    least = 1e-9 * max(abs(low), abs(high))
    if high - low > least:
        return low, high
    return (low / 2.0, low * 2.0) if log else (low - max(0.5, 0.5 * abs(low)), low + max(0.5, 0.5 * abs(low)))


def cumulated(values: Any) -> tuple[FloatArray, FloatArray]:
    """Return sorted finite values, thinned, and the share at or below each of them, %."""
    number = np.asarray(values, dtype=np.float64)
    number = np.sort(number[np.isfinite(number)])
    step = np.unique(np.linspace(0, max(number.size - 1, 0), min(number.size, MAX_STEPS)).astype(np.int64))
    return number[step], 100.0 * (step + 1.0) / max(number.size, 1)


def ticks(low: float, high: float) -> list[float]:
    """Return two to seven round numbers (1, 2 or 5 times a power of ten apart) in a range."""
    if not high > low or not math.isfinite(high - low):
        return [low]
    raw = (high - low) / _MAX_TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * (1 - 1e-9)) * power
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 12 - math.floor(math.log10(step))) + 0.0 for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return two to seven round numbers in a positive range over decades: 1, 2, 5 times powers of ten, or fewer."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
        found = [float(f"{factor:g}e{e}") for e in exponents for factor in factors]
        found = [value for value in found if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)]
        if len(found) <= _MAX_TICKS + 1:
            break
    else:
        found = found[:: math.ceil(len(found) / _MAX_TICKS)]
    return found if len(found) > 1 else ticks(low, high)


def tick_label(value: float) -> str:
    """Return a tick's number as people write it."""
    digits = f"{abs(value):.6g}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")
    return f"\u2212{digits}" if value < 0 else digits


def first_text(values: Iterable[Any]) -> str | None:
    """Return the first of some texts, None without."""
    for value in values:
        return None if value is None else str(value)
    return None
