"""What is wrong with a camera, by how much, and how wrong is a measurement taken with it? In pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.charts.numbers import MISFIT_GROUPS
from sfm_audit.reports.figures.style import (
    BLUE,
    COLOUR_BAR,
    INK,
    MUTED,
    SEQUENTIAL,
    VERMILION,
    new_axes,
    say_nothing_to_show,
    styled,
)

_BESIDE: Final[dict[str, Any]] = {"xytext": (3.0, 0.0), "textcoords": "offset points"}
_TOO_LARGE_PX: Final = 1e100  # nor is NaN below it: axes end at 1e308


@styled
def misfit_groups(row: Mapping[str, Any], *, tau_px: float | None = None, alpha: float = 0.05) -> Figure:
    """Draw the systematic part of the residuals by group, from a row of ``RUN/images`` or ``RUN/cameras``.

    Parameters
    ----------
    tau_px : effect that matters, drawn as a line
    alpha : groups with p above it are drawn hollow: chance could have made them

    Notes
    -----
    On the model as it stands, the image by itself.
    """
    figure, axes = new_axes(height_in=1.9)
    size = [row[f"misfit_{group}_px"] for group in MISFIT_GROUPS]
    p = [row[f"misfit_{group}_p"] for group in MISFIT_GROUPS]
    known = [value is not None and abs(value) < _TOO_LARGE_PX for value in size]
    if not any(known):
        say_nothing_to_show(axes, "no group could be tested")
        return figure
    at = np.arange(len(MISFIT_GROUPS))
    for i, value in enumerate(size):
        if not known[i]:
            why = "the model has it" if row.get(f"misfit_{MISFIT_GROUPS[i]}_rank") == 0 else "not tested"
            axes.annotate(why, (0.0, i), va="center", color=MUTED, fontsize=7, **_BESIDE)
            continue
        sure = p[i] is not None and p[i] < alpha
        axes.barh(i, value, height=0.65, color=BLUE if sure else "none", edgecolor=BLUE, linewidth=0.8)
        label = f"{value:.2f}" if 0.1 <= value < 1000 else f"{value:.2g}"
        axes.annotate(label, (value, i), va="center", fontsize=7, color=INK, **_BESIDE)
    if tau_px is not None and np.isfinite(tau_px):
        axes.axvline(tau_px, color=VERMILION, linewidth=1.0, linestyle="--")
        axes.text(tau_px, -0.75, f"matters above {tau_px:.2g}", color=VERMILION, fontsize=7, ha="center", va="bottom")
    axes.set_yticks(at, [group.replace("_", " ") for group in MISFIT_GROUPS])
    axes.set_ylim(len(MISFIT_GROUPS) - 0.4, -0.8)
    least = tau_px if tau_px is not None and tau_px > 0 and np.isfinite(tau_px) else 0.05
    axes.set_xlim(0.0, 1.2 * max([value for value, there in zip(size, known, strict=True) if there] + [least]))
    axes.set_xlabel(f"systematic residual, px RMS (hollow: p > {alpha:g})")
    return figure


@styled
def expected_error(error_px: FloatArray, size_px: tuple[float, float]) -> Figure:
    """Draw the expected error of one measurement over the image; error_px (rows, columns), NaN where no ray goes."""
    figure, axes = new_axes(height_in=3.2)
    if not np.isfinite(error_px).any():
        say_nothing_to_show(axes, "the parameters are not identified: no error can be given")
        return figure
    width, height = size_px
    rows, columns = error_px.shape
    edges = np.linspace(0.0, width, columns + 1), np.linspace(0.0, height, rows + 1)
    mesh = axes.pcolormesh(*edges, np.ma.masked_invalid(error_px), cmap=SEQUENTIAL)
    figure.colorbar(mesh, ax=axes, label="expected error, px", **COLOUR_BAR)
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_xticks([0.0, width])
    axes.set_yticks([0.0, height])
    axes.set_title(f"median {np.nanmedian(error_px):.2g} px")
    return figure
