"""Where in the image are the residuals, and which way do they point? In pictures."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.charts.numbers import ARROW_SHARE, cell_means, evenly, magnification, profile, radial_parts
from sfm_audit.reports.charts.residuals import Residuals
from sfm_audit.reports.figures.style import (
    BLUE,
    COLOUR_BAR,
    MUTED,
    SEQUENTIAL,
    VERMILION,
    WIDTH_IN,
    new_axes,
    say_nothing_to_show,
    styled,
)

_MAX_HEIGHT_IN: Final = 4.2
_ON_CELLS: Final = "#fdfdfd"  # on coloured cells, whatever the page is like
_AROUND: Final = "#222222"
_NOBODY: Final = "no inliers"


@styled
def residual_vectors(
    residuals: Residuals, *, max_vectors: int = 300, magnify: float | None = None, what: str = "residuals"
) -> Figure:
    """Draw the residuals as arrows at the observed points, magnified.

    Parameters
    ----------
    max_vectors : at most so many, evenly through the order in which the points are stored
    magnify : length of an arrow in image px per px of residual; by default one that shows the long ones well
    what : what the arrows are, for the title
    """
    figure, axes = _image_axes(residuals)
    draw_residual_vectors(axes, residuals, max_vectors=max_vectors, magnify=magnify, what=what)
    return figure


def draw_residual_vectors(
    axes: Axes, residuals: Residuals, *, max_vectors: int = 300, magnify: float | None = None, what: str = "residuals"
) -> None:
    """Draw the same into axes of the caller's, which get the image's frame; their style is left alone."""
    _frame(axes, residuals)
    if not len(residuals):
        say_nothing_to_show(axes, _NOBODY)
        return
    chosen = evenly(len(residuals), max_vectors)
    length = np.hypot(*residuals.residual_px.T)
    factor = magnify or magnification(float(np.quantile(length, 0.9)), max(residuals.size_px))
    _arrows(axes, residuals.xy_px[chosen], residuals.residual_px[chosen], factor, BLUE)
    shown = what if len(chosen) == len(residuals) else f"{len(chosen)} of {len(residuals)} {what}"
    axes.set_title(f"{shown}, × {factor:g}")


@styled
def residual_field(residuals: Residuals, *, cells: int = 10, min_per_cell: int = 3) -> Figure:
    """Draw the mean residual of each cell of the sensor: what is systematic stays, noise averages out.

    Parameters
    ----------
    cells : along the longer side
    min_per_cell : cells with fewer inliers stay empty

    Notes
    -----
    Arrows are dark where the mean is longer than noise of sd ``sigma_px`` leaves in one cell of a hundred.
    """
    figure, axes = _image_axes(residuals, 0.5)
    if not len(residuals):
        say_nothing_to_show(axes, _NOBODY)
        return figure
    means = cell_means(residuals, cells=cells, min_per_cell=min_per_cell)
    side, (rows, columns), full, beyond = means.side_px, means.shape, means.full, means.beyond
    if not full.any():
        say_nothing_to_show(axes, f"no cell with {min_per_cell} inliers")
        return figure
    length = means.length_px
    shown = np.ma.masked_array(length, ~full).reshape(rows, columns)
    edges = np.arange(columns + 1) * side, np.arange(rows + 1) * side
    mesh = axes.pcolormesh(*edges, shown, cmap=SEQUENTIAL, vmin=0.0, rasterized=False, alpha=0.9)
    figure.colorbar(mesh, ax=axes, label="mean residual, px", **COLOUR_BAR)
    factor = magnification(float(np.quantile(length[full], 0.9)), 1.2 * side / ARROW_SHARE)
    for these, colour in ((full & ~beyond, _ON_CELLS), (beyond, VERMILION)):
        _arrows(axes, means.centre_px[these], means.mean_px[these], factor, colour, width=0.006, edge=_AROUND)
    axes.set_title(f"cell means, × {factor:g}; orange: beyond noise ({int(beyond.sum())} of {int(full.sum())})")
    return figure


@styled
def radial_profile(residuals: Residuals, *, bins: int = 12, max_points: int = 400) -> Figure:
    """Draw the residuals' components towards and across the radius over the distance from the optical axis.

    A lens that bends otherwise than its model lifts the radial mean off zero; a decentred one the tangential mean.
    """
    figure, axes = new_axes()
    if len(residuals) < 2 * bins:
        say_nothing_to_show(axes, f"too few inliers ({len(residuals)}) for a profile")
        return figure
    radius, radial, tangential = radial_parts(residuals)
    chosen = evenly(len(radius), max_points)
    axes.plot(radius[chosen], radial[chosen], ".", color=MUTED, alpha=0.35, markersize=2.0, label="_")
    axes.axhline(0.0, color=MUTED, linewidth=0.6)
    for values, colour, style, name in (
        (radial, VERMILION, "o-", "along the radius"),
        (tangential, BLUE, "s--", "across it"),
    ):
        middle, mean, error = profile(radius, values, bins)
        axes.fill_between(middle, mean - 2.0 * error, mean + 2.0 * error, color=colour, alpha=0.2, linewidth=0)
        axes.plot(middle, mean, style, color=colour, label=f"{name}, mean ± 2 s.e.")
    reach = max(3.5 * residuals.sigma_px, 1e-9)
    axes.set_ylim(-reach, reach)
    axes.set_xlabel("distance from the principal point, px")
    axes.set_ylabel("residual, px")
    axes.legend(loc="upper left", ncols=1)
    return figure


@styled
def inliers_on_photo(residuals: Residuals, photo: NDArray[Any], *, max_points: int = 600) -> Figure:
    """Draw the inliers on their photo, coloured by the length of their residuals.

    photo: (rows, columns) or (rows, columns, 3 or 4), the whole image at any resolution.
    """
    width, height = residuals.size_px
    figure, axes = _image_axes(residuals, 0.5)
    axes.imshow(photo, extent=(0.0, width, height, 0.0), cmap="gray", interpolation="bilinear")
    if len(residuals):
        chosen = evenly(len(residuals), max_points)
        length = np.hypot(*residuals.residual_px.T)
        dots = axes.scatter(
            residuals.xy_px[chosen, 0],
            residuals.xy_px[chosen, 1],
            c=length[chosen],
            s=7.0,
            cmap="inferno",
            vmin=0.0,
            vmax=float(np.quantile(length, 0.95)) or 1.0,
            edgecolors="#ffffff",
            linewidths=0.4,
        )
        figure.colorbar(dots, ax=axes, label="residual, px", **COLOUR_BAR)
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_axis_off()
    return figure


def _image_axes(residuals: Residuals, space_in: float = 0.0) -> tuple[Figure, Axes]:
    """Return axes with the image's frame: x to the right, y down, equal scale; ``space_in`` for a colour bar below."""
    width, height = (float(max(size, 1.0)) for size in residuals.size_px)
    figure, axes = new_axes(WIDTH_IN, min(_MAX_HEIGHT_IN, 0.55 + space_in + 2.9 * min(height / width, 1.4)))
    _frame(axes, residuals)
    return figure, axes


def _frame(axes: Axes, residuals: Residuals) -> None:
    width, height = (float(max(size, 1.0)) for size in residuals.size_px)
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_xticks([0.0, width])
    axes.set_yticks([0.0, height])
    for spine in axes.spines.values():
        spine.set_visible(True)


def _arrows(
    axes: Axes,
    at: FloatArray,
    vector: FloatArray,
    factor: float,
    colour: str,
    *,
    width: float = 0.003,
    edge: str = "none",
) -> None:
    axes.quiver(
        *at.T,
        *(vector * factor).T,
        color=colour,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=width,
        headwidth=4.0,
        headlength=4.5,
        clip_on=True,
        edgecolor=edge,
        linewidth=0.0 if edge == "none" else 0.25,
    )
