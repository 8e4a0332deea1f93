"""Are the standardised residuals N(0, 1), and what would the plain scale have hidden? In pictures."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from scipy import special

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.reports.figures.residuals import Residuals
from sfm_audit.reports.figures.style import BLUE, INK, MUTED, VERMILION, new_axes, say_nothing_to_show, styled

_REACH: Final = 5.0  # sd shown; what lies beyond is counted in the outermost bars
_BINS: Final = 41
_MAX_QUANTILES: Final = 250
_NOBODY: Final = "nothing could be standardised"


@styled
def standardised_histogram(residuals: Residuals) -> Figure:
    """Draw the histogram of z, x and y pooled, against N(0, 1)."""
    figure, axes = new_axes()
    values = residuals.z.ravel()
    if not values.size:
        say_nothing_to_show(axes, _NOBODY)
        return figure
    edges = np.linspace(-_REACH, _REACH, _BINS + 1)
    axes.bar(*_density(values, edges), color=BLUE, alpha=0.6, edgecolor=BLUE, linewidth=0.3, label="residuals")
    x = np.linspace(-_REACH, _REACH, 121)
    axes.plot(x, _normal_density(x), color=INK, label="N(0, 1)")
    beyond = int(np.count_nonzero(np.abs(values) > _REACH))
    axes.set_title(
        f"{values.size} values, sd {values.std():.2f}" + (f", {beyond} beyond ±{_REACH:g}" if beyond else "")
    )
    axes.set_xlabel("standardised residual z")
    axes.set_ylabel("density")
    axes.legend(loc="upper right")
    return figure


@styled
def qq_plot(residuals: Residuals) -> Figure:
    """Draw the quantiles of z over those of N(0, 1), with the band that holds 95 % of each under N(0, 1)."""
    figure, axes = new_axes()
    values = np.sort(residuals.z.ravel())
    if not values.size:
        say_nothing_to_show(axes, _NOBODY)
        return figure
    n = values.size
    rank = _thinned_ranks(n)
    normal = special.ndtri((rank + 0.5) / n)
    low, high = (special.ndtri(special.betaincinv(rank + 1.0, n - rank, p)) for p in (0.025, 0.975))
    axes.fill_between(normal, low, high, color=MUTED, alpha=0.25, linewidth=0, label="95 % of each, if N(0, 1)")
    axes.plot(normal[[0, -1]], normal[[0, -1]], color=INK, linewidth=0.8)
    axes.plot(normal, values[rank], "o", color=BLUE, markersize=2.2, label="residuals")
    axes.set_xlabel("quantile of N(0, 1)")
    axes.set_ylabel("quantile of z")
    axes.legend(loc="upper left")
    return figure


@styled
def scale_comparison(residuals: Residuals) -> Figure:
    """Draw the same raw residuals under the robust scale and under their plain standard deviation.

    A few large residuals inflate the plain scale until everything looks normal; the robust one shows the tails.
    """
    figure, axes = new_axes()
    values = residuals.residual_px.ravel()
    plain = float(values.std()) if values.size else 0.0
    if not values.size or not plain > 0 or not residuals.sigma_px > 0:
        say_nothing_to_show(axes, "no residuals" if not values.size else "all residuals are alike")
        return figure
    edges = np.linspace(-_REACH, _REACH, _BINS + 1)
    middle, height, width = _density(values / residuals.sigma_px, edges)
    axes.bar(middle, height, width, color=BLUE, alpha=0.5, label=f"robust scale, {residuals.sigma_px:.3g} px")
    _, other, _ = _density(values / plain, edges)
    axes.stairs(other, edges, color=VERMILION, linewidth=1.2, label=f"plain scale, {plain:.3g} px")
    x = np.linspace(-_REACH, _REACH, 121)
    axes.plot(x, _normal_density(x), color=INK, linestyle="--", label="N(0, 1)")
    axes.set_yscale("log")
    axes.set_ylim(0.3 / (values.size * width), 12.0)
    axes.set_xlabel("residual / scale (outer bars: all beyond)")
    axes.set_ylabel("density")
    axes.legend(loc="upper left")
    return figure


def _density(values: FloatArray, edges: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Middles, heights and width of bars; values beyond the edges are counted in the outermost bars."""
    width = float(edges[1] - edges[0])
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return (edges[:-1] + edges[1:]) / 2.0, counts / (values.size * width), width


def _normal_density(x: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))


def _thinned_ranks(n: int) -> IntArray:
    """Ranks 0..n-1: all of the tails, evenly thinned between them."""
    if n <= _MAX_QUANTILES:
        return np.arange(n, dtype=np.int64)
    tail = _MAX_QUANTILES // 8
    inner = np.linspace(tail, n - 1 - tail, _MAX_QUANTILES - 2 * tail).astype(np.int64)
    return np.unique(np.concatenate([np.arange(tail), inner, np.arange(n - tail, n)]))
