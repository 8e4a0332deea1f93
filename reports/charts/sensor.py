"""Where in the image are the residuals, and which way do they point? As SVG."""

from __future__ import annotations

from typing import Final

import numpy as np
from markupsafe import Markup

from sfm_audit.reports.charts.canvas import WIDTH, Axis, Chart, nothing
from sfm_audit.reports.charts.captions import CAPTIONS
from sfm_audit.reports.charts.numbers import ARROW_SHARE, cell_means, evenly, magnification, profile, radial_parts
from sfm_audit.reports.charts.residuals import Residuals

MAX_VECTORS: Final = 300
_MAX_POINTS: Final = 250
_BINS: Final = 12
_STEPS: Final = 5  # of lightness, for the length of a cell's mean


def residual_vectors(residuals: Residuals, *, max_vectors: int = MAX_VECTORS) -> Markup:
    """Draw the residuals as arrows at their points, magnified."""
    label = CAPTIONS["residual_vectors"]
    if not len(residuals):
        return nothing("no inliers", label)
    chart = sensor_chart(residuals.size_px)
    chosen = evenly(len(residuals), max_vectors)
    length = np.hypot(*residuals.residual_px.T)
    factor = magnification(float(np.quantile(length, 0.9)), max(residuals.size_px))
    at = residuals.xy_px[chosen]
    chart.arrows(at, at + factor * residuals.residual_px[chosen], "blue")
    what = "residuals" if len(chosen) == len(residuals) else f"{len(chosen)} of {len(residuals)} residuals"
    chart.title(f"{what}, \u00d7 {factor:g}")
    return chart.svg(label)


def residual_field(residuals: Residuals, *, cells: int = 10, label: str | None = None) -> Markup:
    """Draw the mean residual of each cell of the sensor, as shade and as arrow; strong arrows are beyond noise."""
    label = CAPTIONS["residual_field"] if label is None else label
    if not len(residuals):
        return nothing("no inliers", label)
    means = cell_means(residuals, cells=cells)
    if not means.full.any():
        return nothing("no cell with 3 inliers", label)
    chart = sensor_chart(residuals.size_px)
    length = means.length_px
    longest = float(length[means.full].max()) or 1.0
    step = np.minimum((_STEPS * np.where(means.full, length, 0.0) / longest).astype(np.int64), _STEPS - 1)
    half = means.side_px / 2.0
    for shade in range(1, _STEPS):
        corners = [chart.place(*(means.centre_px[means.full & (step == shade)] + s * half).T) for s in (-1.0, 1.0)]
        boxes = np.column_stack(corners).tolist()
        d = "".join(f"M{a:.1f} {b:.1f}H{c:.1f}V{e:.1f}H{a:.1f}Z" for a, b, c, e in boxes)
        chart.raw(f'<path class="cell" fill-opacity="{0.13 * shade:.2f}" d="{d}"/>')
    factor = magnification(float(np.quantile(length[means.full], 0.9)), 1.2 * means.side_px / ARROW_SHARE)
    for these, look in ((means.full & ~means.beyond, "muted"), (means.beyond, "vermilion strong")):
        at = means.centre_px[these]
        chart.arrows(at, at + factor * means.mean_px[these], look, head=4.5)
    beyond, full = int(means.beyond.sum()), int(means.full.sum())
    chart.title(f"cell means, \u00d7 {factor:g}, longest {longest:.2g} px; beyond noise: {beyond} of {full}")
    return chart.svg(label)


def radial_profile(residuals: Residuals) -> Markup:
    """Draw the residuals' components along and across the radius over the distance from the optical axis."""
    label = CAPTIONS["radial_profile"]
    if len(residuals) < 2 * _BINS:
        return nothing(f"too few inliers ({len(residuals)}) for a profile", label)
    radius, radial, tangential = radial_parts(residuals)
    reach = max(3.5 * residuals.sigma_px, 1e-9)
    x = Axis(0.0, float(radius.max()) or 1.0, "distance from the principal point, px")
    chart = Chart(x, Axis(-reach, reach, "residual, px"))
    chosen = evenly(len(radius), _MAX_POINTS)
    chart.dots(radius[chosen], radial[chosen], "faint", radius=1.0)
    chart.level(0.0)
    for values, colour, dash in ((radial, "vermilion", ""), (tangential, "blue", " dashed")):
        middle, mean, error = profile(radius, values, _BINS)
        chart.band(middle, mean - 2.0 * error, mean + 2.0 * error, f"band {colour}")
        chart.line(middle, mean, f"line {colour}{dash}")
        chart.dots(middle, mean, colour, radius=2.2)
    names = [("line vermilion", "along the radius"), ("line blue dashed", "across it")]
    chart.legend(names, corner="top left")
    chart.title("means \u00b1 2 standard errors")
    return chart.svg(label)


def inliers_on_photo(residuals: Residuals, photo_url: str, *, max_points: int = 500) -> Markup:
    """Draw the inliers on their photo, larger and warmer the longer the residual; ``photo_url``: a data URL."""
    width, height = residuals.size_px
    size = (WIDTH, max(WIDTH * height / max(width, 1.0), 1.0))
    chart = Chart(Axis(0.0, width, marks=()), Axis(height, 0.0, marks=()), size=size, margin=(0.0, 0.0, 0.0, 0.0))
    chart.raw(f'<image href="{photo_url}" width="{size[0]:.1f}" height="{size[1]:.1f}" preserveAspectRatio="none"/>')
    if len(residuals):
        chosen = evenly(len(residuals), max_points)
        length = np.hypot(*residuals.residual_px.T)
        low, high = (float(np.quantile(length, q)) for q in (0.5, 0.9))
        step = np.digitize(length[chosen], [low, high])
        at = residuals.xy_px[chosen]
        for k in range(3):
            these = at[step == k]
            chart.dots(these[:, 0], these[:, 1], "halo", radius=2.2 + 0.6 * k)
            chart.dots(these[:, 0], these[:, 1], f"heat-{k}", radius=1.5 + 0.6 * k)
    return chart.svg(CAPTIONS["inliers_on_photo"])


def sensor_chart(size_px: tuple[float, float]) -> Chart:
    """Return a chart with the image's frame: x to the right, y down, equal scale."""
    width, height = (float(max(size, 1.0)) for size in size_px)
    margin = (12.0, 14.0, 20.0, 18.0)
    x = Axis(0.0, width, marks=((0.0, "0"), (width, f"{width:g}")))
    y = Axis(height, 0.0, marks=((0.0, "0"), (height, f"{height:g}")))
    room = (WIDTH - margin[0] - margin[1] - 5.8 * len(f"{height:g}"), 330.0)
    scale = min(room[0] / width, room[1] / height)
    taken = WIDTH - room[0], margin[2] + margin[3]
    side = max(0.0, room[0] - scale * width)
    margin = (margin[0], margin[1] + side, margin[2], margin[3])
    return Chart(x, y, size=(taken[0] + room[0], taken[1] + scale * height), margin=margin, frame=True)
