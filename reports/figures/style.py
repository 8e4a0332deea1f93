"""How do all figures look? One palette that colour-blind people can tell apart, one type size, no decoration.

Colours: Okabe and Ito's (2008). Where two things share axes they also differ in line style, marker or hatching.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final, ParamSpec

import numpy as np
from matplotlib import style as mplstyle
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE: Final = "#0072b2"
VERMILION: Final = "#d55e00"
GREEN: Final = "#009e73"
AMBER: Final = "#e69f00"
INK: Final = "#1a1a1a"
MUTED: Final = "#5f6368"
GRID: Final = "#dadce0"
NO_COLOUR: Final = "none"

VERDICT_COLOURS: Final = {"accepted": BLUE, "rejected": VERMILION, "undetermined": MUTED}
VERDICT_HATCHES: Final = {"accepted": "", "rejected": "////", "undetermined": "...."}
SEQUENTIAL: Final = "cividis"  # lightness rises monotonically, the same with any colour vision

COLOUR_BAR: Final[dict[str, Any]] = {"location": "bottom", "fraction": 0.05, "pad": 0.04, "aspect": 40}

WIDTH_IN: Final = 3.5
HEIGHT_IN: Final = 2.7

_STYLE: Final[dict[str, object]] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": False,
    "axes.axisbelow": True,
    "axes.facecolor": NO_COLOUR,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.0,
    "hatch.linewidth": 0.6,
    "hatch.color": "#ffffff",
    "figure.facecolor": "#ffffff",
    "figure.dpi": 120.0,
    "savefig.dpi": 160.0,
    "savefig.facecolor": "#ffffff",
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
}

P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Make a drawing function use the house style, whatever matplotlib is set to elsewhere."""

    @functools.wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mplstyle.context(["default", _STYLE]), np.errstate(all="ignore"):  # numbers near 1e308 leave the axes
            return draw(*args, **kwargs)

    return wrapped


def new_axes(width_in: float = WIDTH_IN, height_in: float = HEIGHT_IN) -> tuple[Figure, Axes]:
    """Return a figure with one pair of axes; not registered with pyplot, so nobody has to close it."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    return figure, figure.add_subplot()


def say_nothing_to_show(axes: Axes, why: str) -> None:
    """Write in place of a picture why there is none."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes, color=MUTED, wrap=True)
