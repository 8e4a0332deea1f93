"""Are the standardised residuals N(0, 1), and what would the plain scale have hidden? In pictures."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from sfm_audit.reports.charts.numbers import REACH_SD, Z_BINS, density, normal_density, quantiles
from sfm_audit.reports.charts.residuals import Residuals
from sfm_audit.reports.figures.style import BLUE, INK, MUTED, VERMILION, new_axes, say_nothing_to_show, styled

_NOBODY: Final = "nothing could be standardised"


@styled
def standardised_histogram(residuals: Residuals) -> Figure:
    """Draw the histogram of z, x and y pooled, against N(0, 1)."""
    figure, axes = new_axes()
    values = residuals.z.ravel()
    if not values.size:
        say_nothing_to_show(axes, _NOBODY)
        return figure
    edges = np.linspace(-REACH_SD, REACH_SD, Z_BINS + 1)
    axes.bar(*density(values, edges), color=BLUE, alpha=0.6, edgecolor=BLUE, linewidth=0.3, label="residuals")
    x = np.linspace(-REACH_SD, REACH_SD, 121)
    axes.plot(x, normal_density(x), color=INK, label="N(0, 1)")
    beyond = int(np.count_nonzero(np.abs(values) > REACH_SD))
    axes.set_title(
        f"{values.size} values, sd {values.std():.2f}" + (f", {beyond} beyond ±{REACH_SD:g}" if beyond else "")
    )
    axes.set_xlabel("standardised residual z")
    axes.set_ylabel("density")
    axes.legend(loc="upper right")
    return figure


@styled
def qq_plot(residuals: Residuals) -> Figure:
    """Draw the quantiles of z over those of N(0, 1), with the band that holds 95 % of each under N(0, 1)."""
    figure, axes = new_axes()
    values = residuals.z
    if not values.size:
        say_nothing_to_show(axes, _NOBODY)
        return figure
    q = quantiles(values)
    axes.fill_between(q.normal, q.low, q.high, color=MUTED, alpha=0.25, linewidth=0, label="95 % of each, if N(0, 1)")
    axes.plot(q.normal[[0, -1]], q.normal[[0, -1]], color=INK, linewidth=0.8)
    axes.plot(q.normal, q.found, "o", color=BLUE, markersize=2.2, label="residuals")
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
    edges = np.linspace(-REACH_SD, REACH_SD, Z_BINS + 1)
    middle, height, width = density(values / residuals.sigma_px, edges)
    axes.bar(middle, height, width, color=BLUE, alpha=0.5, label=f"robust scale, {residuals.sigma_px:.3g} px")
    _, other, _ = density(values / plain, edges)
    axes.stairs(other, edges, color=VERMILION, linewidth=1.2, label=f"plain scale, {plain:.3g} px")
    x = np.linspace(-REACH_SD, REACH_SD, 121)
    axes.plot(x, normal_density(x), color=INK, linestyle="--", label="N(0, 1)")
    axes.set_yscale("log")
    axes.set_ylim(0.3 / (values.size * width), 12.0)
    axes.set_xlabel("residual / scale (outer bars: all beyond)")
    axes.set_ylabel("density")
    axes.legend(loc="upper left")
    return figure
