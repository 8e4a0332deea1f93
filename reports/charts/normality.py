"""Are the standardised residuals N(0, 1), and what would the plain scale have hidden? As SVG."""

from __future__ import annotations

from typing import Final

import numpy as np
from markupsafe import Markup

from sfm_audit.reports.charts.canvas import Axis, Chart, nothing
from sfm_audit.reports.charts.captions import CAPTIONS
from sfm_audit.reports.charts.numbers import REACH_SD, Z_BINS, density, normal_density, quantiles
from sfm_audit.reports.charts.residuals import Residuals

_EDGES: Final = np.linspace(-REACH_SD, REACH_SD, Z_BINS + 1)
_NORMAL: Final = np.linspace(-REACH_SD, REACH_SD, 81)
_NONE: Final = "nothing could be standardised"


def standardised_histogram(residuals: Residuals) -> Markup:
    """Draw the histogram of z, x and y pooled, against N(0, 1)."""
    label = CAPTIONS["standardised_histogram"]
    values = residuals.z.ravel()
    if not values.size:
        return nothing(_NONE, label)
    _, height, _ = density(values, _EDGES)
    top = 1.1 * max(float(height.max()), 0.4)
    chart = Chart(Axis(-REACH_SD, REACH_SD, "standardised residual z"), Axis(0.0, top, "density"))
    chart.bars(_EDGES, 0.0, height, "bar blue")
    chart.line(_NORMAL, normal_density(_NORMAL), "line ink")
    chart.legend([("bar blue", "residuals"), ("line ink", "N(0, 1)")])
    beyond = int(np.count_nonzero(np.abs(values) > REACH_SD))
    outside = f", {beyond} beyond \u00b1{REACH_SD:g}" if beyond else ""
    with np.errstate(over="ignore", invalid="ignore"):
        chart.title(f"{values.size} values, sd {values.std():.2f}{outside}")
    return chart.svg(label)


def qq_plot(residuals: Residuals) -> Markup:
    """Draw the quantiles of z over those of N(0, 1), with the band that holds 95 % of each under N(0, 1)."""
    label = CAPTIONS["qq_plot"]
    if not residuals.z.size:
        return nothing(_NONE, label)
    q = quantiles(residuals.z)
    reach = float(max(abs(q.normal[0]), abs(q.normal[-1]), 1.0))
    low, high = min(float(q.found[0]), -reach), max(float(q.found[-1]), reach)
    chart = Chart(Axis(-1.05 * reach, 1.05 * reach, "quantile of N(0, 1)"), Axis(low, high, "quantile of z"))
    chart.band(q.normal, q.low, q.high, "band muted")
    chart.line([-reach, reach], [-reach, reach], "line ink")
    chart.dots(q.normal, q.found, "blue", radius=1.5)
    names = [("bar blue", "residuals"), ("band muted", "95 % of each, if N(0, 1)")]
    chart.legend(names, corner="top left")
    return chart.svg(label)


def scale_comparison(residuals: Residuals) -> Markup:
    """Draw the same raw residuals under the robust scale and under their plain standard deviation."""
    label = CAPTIONS["scale_comparison"]
    values = residuals.residual_px.ravel()
    with np.errstate(over="ignore", invalid="ignore"):
        plain = float(values.std()) if values.size else 0.0
    if not values.size or not plain > 0 or not residuals.sigma_px > 0 or not np.isfinite(plain):
        return nothing("no residuals" if not values.size else "all residuals are alike", label)
    _, height, width = density(values / residuals.sigma_px, _EDGES)
    _, other, _ = density(values / plain, _EDGES)
    least = 0.3 / (values.size * width)
    chart = Chart(
        Axis(-REACH_SD, REACH_SD, "residual / scale (outer bars: all beyond)"), Axis(least, 12.0, "density", log=True)
    )
    chart.bars(_EDGES, least, np.maximum(height, least), "bar blue")
    steps = np.repeat(np.maximum(other, least), 2)
    chart.line(np.repeat(_EDGES, 2)[1:-1], steps, "line vermilion")
    chart.line(_NORMAL, normal_density(_NORMAL), "line ink dashed")
    chart.legend(
        [
            ("bar blue", f"robust scale, {residuals.sigma_px:.3g} px"),
            ("line vermilion", f"plain scale, {plain:.3g} px"),
            ("line ink dashed", "N(0, 1)"),
        ],
        corner="top left",
    )
    return chart.svg(label)
