"""One image's residuals in axes of the user's. Imports matplotlib."""

from __future__ import annotations

from matplotlib.axes import Axes

from sfm_audit.reports.charts.residuals import Residuals
from sfm_audit.reports.figures import draw_residual_vectors


def plot_residuals(residuals: Residuals, ax: Axes | None, title: str, magnify: float | None) -> Axes:
    """Draw the residuals as arrows into ``ax``, or into new axes of pyplot's, which a notebook shows."""
    axes = ax if ax is not None else _new_axes()
    draw_residual_vectors(axes, residuals, magnify=magnify)
    axes.set_title(f"{title}\n{axes.get_title()}".rstrip())
    return axes


def _new_axes() -> Axes:
    from matplotlib import pyplot as plt  # noqa: PLC0415 - the command line draws without it

    return plt.subplots(layout="constrained")[1]
