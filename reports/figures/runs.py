"""How are the numbers of a run distributed over its images? In pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.charts.numbers import MAX_STEPS, bulk, first_text, histogram, log_ticks, tick_label
from sfm_audit.reports.figures.style import (
    BLUE,
    INK,
    MUTED,
    VERDICT_COLOURS,
    VERDICT_HATCHES,
    VERMILION,
    WIDTH_IN,
    new_axes,
    say_nothing_to_show,
    styled,
)


class RunColumns(Protocol):
    """``pandas.read_parquet(RUN + "/images")``, an Arrow table, or a dict of arrays by column name."""

    def __getitem__(self, name: str, /) -> Any:
        """Return one column."""


@styled
def verdict_bars(counts: Mapping[str, Mapping[str, int]]) -> Figure:
    """Draw one bar per question, split into accepted, rejected and undetermined.

    counts: question -> verdict -> number of images.
    """
    figure, axes = new_axes(1.4 * WIDTH_IN, 0.75 + 0.27 * len(counts))
    at = np.arange(len(counts))
    left = np.zeros(len(counts))
    totals = np.maximum([sum(by.values()) for by in counts.values()], 1)
    for verdict, colour in VERDICT_COLOURS.items():
        number = np.array([by.get(verdict, 0) for by in counts.values()])
        share = 100.0 * number / totals
        axes.barh(
            at, share, 0.7, left, color=colour, hatch=VERDICT_HATCHES[verdict], edgecolor="#ffffff", label=verdict
        )
        for i, value in enumerate(share):
            if value >= 4.0:
                where = left[i] + value / 2.0
                box = {"boxstyle": "square,pad=0.15", "facecolor": colour, "edgecolor": "none"}
                axes.text(where, i, f"{number[i]}", ha="center", va="center", color="#ffffff", fontsize=7, bbox=box)
        left += share
    axes.set_yticks(at, list(counts))
    axes.set_ylim(len(counts) - 0.5, -0.5)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("images, %")
    figure.legend(loc="outside upper center", ncols=3)
    return figure


@styled
def histogram_by_verdict(
    values: Sequence[float] | FloatArray,
    verdicts: Sequence[str],
    *,
    label: str,
    log: bool = False,
    marks: Mapping[str, float] | None = None,
) -> Figure:
    """Draw the distribution of a number over images, stacked by verdict.

    Parameters
    ----------
    values : one per image; those that are not finite are counted in the title
    verdicts : accepted, rejected or undetermined, one per image
    label : what the number is, with its unit
    log : on a logarithmic axis, for positive numbers over decades
    marks : thresholds to draw as lines, by name
    """
    figure, axes = new_axes()
    found = histogram(values, verdicts, log=log)
    if found is None:
        say_nothing_to_show(axes, f"{label}: none computed")
        return figure
    edges = found.edges
    base = np.zeros(len(edges) - 1)
    for name, colour in VERDICT_COLOURS.items():
        height = found.counts[name]
        look: dict[str, Any] = {
            "color": colour,
            "hatch": VERDICT_HATCHES[name],
            "edgecolor": "#ffffff",
            "linewidth": 0.2,
        }
        axes.bar(edges[:-1], height, np.diff(edges), base, align="edge", label=name, **look)
        base = base + height
    for name, at in (marks or {}).items():
        axes.axvline(at, color=INK, linewidth=0.8, linestyle="--", label=name)
    if log:
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
        round_values = log_ticks(float(edges[0]), float(edges[-1]))
        axes.set_xticks(round_values, [tick_label(value) for value in round_values])
    axes.set_title(f"{found.shown} images" + (f", {found.missing} without the number" if found.missing else ""))
    axes.set_xlabel(label)
    axes.set_ylabel("images")
    figure.legend(loc="outside upper left", ncols=2)
    return figure


@styled
def noise_comparison(
    first: Sequence[float] | FloatArray, second: Sequence[float] | FloatArray, *, names: tuple[str, str], label: str
) -> Figure:
    """Draw the cumulative distributions of the same number under two noise models."""
    figure, axes = new_axes()
    drawn = False
    for values, name, colour, style in ((first, names[0], VERMILION, "--"), (second, names[1], BLUE, "-")):
        number = np.asarray(values, dtype=np.float64)
        number = np.sort(number[np.isfinite(number)])
        if number.size:
            drawn = True
            share = (np.arange(number.size) + 1.0) / number.size
            step = np.unique(np.linspace(0, number.size - 1, min(number.size, MAX_STEPS)).astype(np.int64))
            median = float(np.median(number))
            axes.plot(
                number[step], 100.0 * share[step], color=colour, linestyle=style, label=f"{name}: median {median:.2g}"
            )
    if not drawn:
        say_nothing_to_show(axes, f"{label}: none computed")
        return figure
    _limit_to_bulk(axes, [first, second])
    axes.set_ylim(0.0, 100.0)
    axes.set_xlabel(label)
    axes.set_ylabel("images at or below, %")
    axes.legend(loc="lower right")
    return figure


@styled
def ks_comparison(images: RunColumns, *, alpha: float = 0.05) -> Figure:
    """Draw how often KS would reject at any level, under constant noise and under the run's noise model.

    A test of the right size follows the diagonal where all images are sound.
    """
    figure, axes = new_axes()
    name = first_text(images["noise_model"])
    drawn = False
    for column, label, colour, style in (
        ("ks_constant_p", "constant", VERMILION, "--"),
        ("ks_p", name or "chosen", BLUE, "-"),
    ):
        p = np.asarray(images[column], dtype=np.float64)
        p = np.sort(p[np.isfinite(p)])
        if not p.size or (column == "ks_p" and name == "constant"):
            continue
        drawn = True
        share = 100.0 * np.arange(p.size + 1) / p.size
        step = np.unique(np.linspace(0, p.size - 1, min(p.size, MAX_STEPS)).astype(np.int64))
        rejected = 100.0 * np.count_nonzero(p < alpha) / p.size
        axes.plot(
            np.concatenate([[0.0], p[step], [1.0]]),
            np.concatenate([[0.0], share[step + 1], [100.0]]),
            color=colour,
            linestyle=style,
            label=f"{label} noise: {rejected:.0f} % at {alpha:g}",
        )
    if not drawn:
        say_nothing_to_show(axes, "KS was not computed")
        return figure
    axes.plot([0.0, 1.0], [0.0, 100.0], color=MUTED, linewidth=0.7)
    axes.axvline(alpha, color=INK, linewidth=0.8, linestyle=":")
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 100.0)
    axes.set_xlabel("p of Kolmogorov-Smirnov")
    axes.set_ylabel("images with a smaller p, %")
    axes.legend(loc="lower right")
    return figure


def _limit_to_bulk(axes: Any, series: Sequence[Any]) -> None:
    values: NDArray[np.float64] = np.concatenate([np.asarray(one, dtype=np.float64) for one in series])
    low, high = bulk(values[np.isfinite(values)], log=False)
    axes.set_xlim(low, high)
