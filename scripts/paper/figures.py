"""The page's figures, as SVG, in the house style."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from scripts.paper.board_study import RENDERED, RIGHT, WRONG
from scripts.paper.claims import Tables, of_model
from scripts.paper.megadepth import EDGES, NOISES, histogram_columns
from scripts.paper.motivating import CLAIMED, TAIL, sample, scale_of
from scripts.paper.rates import ALPHA, chosen, rates_by_third
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.figures.style import AMBER, BLUE, GRID, INK, MUTED, VERMILION, styled

WIDTH: Final = 7.2
FLOOR: Final = 1e-6  # smaller p-values are drawn there
PANELS: Final = (
    ("ks_robust", "KS, signed, robust scale"),
    ("ks_plain", "KS, signed, ML scale"),
    ("dap_robust", "D'Agostino-Pearson"),
    ("sw_robust", "Shapiro-Wilk"),
    ("ks_fitted_robust", "ks_fitted"),
    ("ks_norm_robust", "ks_norm"),
    ("ks_norm_unscaled_plain", "KS of lengths, ML scale"),
    ("misfit_p", "misfit, smallest Holm p"),
)
NAMES: Final = {WRONG: "D(1,0), wrong", RIGHT: "D(3,0), right"}
COLOURS: Final = {WRONG: VERMILION, RIGHT: BLUE}
_MARKERS: Final = {WRONG: "o", RIGHT: "^"}
_NOISE_COLOURS: Final = {"constant": VERMILION, "track": BLUE}
_NOISE_STYLES: Final = {"constant": "--", "track": "-"}
_SEED: Final = 3


def draw_figures(tables: Tables, folder: Path, suffix: str = "svg") -> list[Path]:
    """Draw all figures for which there are numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    boards = tables["boards"]
    sources = sorted(boards["source"].unique())
    source = RENDERED if RENDERED in sources else sources[0]
    boards = chosen(boards, source=source, refused="no")
    figures = {"motivating": motivating(), "figure3": figure3(boards), "sd": deviations(boards)}
    if "megadepth" in tables:
        figures["megadepth"] = megadepth(tables["megadepth"])
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"paper_{name}.{suffix}")
        with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "paper"}):
            figure.savefig(paths[-1], metadata={"Date": None} if suffix == "svg" else None, dpi=110)
    return paths


@styled
def motivating(n: int = 225, sigma: float = 0.05) -> Figure:
    """Draw the data with both lines, and the residuals' quantiles under both scales."""
    rng = np.random.default_rng(_SEED)
    x, residuals = sample(n, sigma, CLAIMED, rng)
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    grid = np.linspace(-1.0, 1.0, 201)
    left.plot(x, residuals + x + CLAIMED * x**5, ".", color=MUTED, markersize=2.5, label="measured")
    left.plot(grid, grid, color=BLUE, label="true: y = x")
    left.plot(grid, grid + CLAIMED * grid**5, "--", color=VERMILION, label=f"claimed: y = x + {CLAIMED:g} x⁵")
    left.set(xlabel="x", ylabel="y")
    left.legend(loc="upper left")
    normal = stats.norm.ppf((np.arange(1, n + 1) - 0.5) / n)
    right.axhspan(-TAIL, TAIL, color=GRID, alpha=0.4, linewidth=0)
    right.plot([-4, 4], [-4, 4], color=INK, linewidth=0.8)
    for name, colour, marker in (("winsorised", BLUE, "o"), ("plain", AMBER, "^")):
        z = np.sort(residuals / scale_of(residuals, name))
        label = "robust scale" if name == "winsorised" else "plain scale"
        right.plot(normal, z, marker, color=colour, markersize=2.5, linestyle="none", label=label)
    right.set(xlabel="quantile of N(0, 1)", ylabel="standardised residual", xlim=(-3.2, 3.2))
    right.legend(loc="upper left")
    return figure


@styled
def figure3(boards: pd.DataFrame) -> Figure:
    """Draw p over the sets, sorted by coverage: median and range of 80 % over seeds, thirds and their rates."""
    figure = Figure(figsize=(WIDTH, 8.6), layout="constrained")
    axes = figure.subplots(4, 2, sharex=True, sharey=True)
    for axis, (column, title) in zip(axes.flat, PANELS, strict=True):
        _sets_panel(axis, boards, column)
        axis.set_yscale("log")
        axis.set_ylim(0.6 * FLOOR, 40.0)
        axis.set_yticks([1e-6, 1e-4, 1e-2, 1.0], ["≤ 1e-6", "1e-4", "0.01", "1"])
        axis.minorticks_off()
        axis.axhline(ALPHA, color=INK, linewidth=0.7, linestyle=":")
        axis.set_title(title)
        _rates(axis, boards, column)
    for axis in axes[-1]:
        axis.set_xlabel("set, by coverage")
    for axis in axes[:, 0]:
        axis.set_ylabel("p-value")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _sets_panel(axis: Axes, boards: pd.DataFrame, column: str) -> None:
    """Draw both cameras' medians and bands over the sets."""
    num = int(boards["set"].max())
    for k in (1, 2):
        axis.axvline(k * num / 3.0 + 0.5, color=GRID, linewidth=0.8)
    for model, name in NAMES.items():
        by_set = of_model(boards, model).groupby("set")[column]
        low, middle, high = (by_set.quantile(q).clip(lower=FLOOR) for q in (0.1, 0.5, 0.9))
        axis.fill_between(middle.index, low, high, color=COLOURS[model], alpha=0.2, linewidth=0)
        axis.plot(
            middle.index, middle, _MARKERS[model], color=COLOURS[model], markersize=2.3, linestyle="none", label=name
        )


def _rates(axis: Axes, boards: pd.DataFrame, column: str) -> None:
    """Write the shares rejected by third above the points."""
    num = int(boards["set"].max())
    for row, model in enumerate(NAMES):
        rates = rates_by_third(of_model(boards, model), column)
        for k, rate in enumerate(rates):
            place = (k + 0.5) * num / 3.0 + 0.5
            text = f"{100 * rate:.0f} %"
            axis.text(place, (14.0, 3.6)[row], text, color=COLOURS[model], ha="center", va="center", fontsize=7.0)


@styled
def deviations(boards: pd.DataFrame) -> Figure:
    """Draw empirical and predicted standard deviations, and the effect of misfit with what it must exceed."""
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    for axis in (left, right):
        for k in (1, 2):
            axis.axvline(k * int(boards["set"].max()) / 3.0 + 0.5, color=GRID, linewidth=0.8)
        axis.set(yscale="log", xlabel="set, by coverage")
    for model, name in NAMES.items():
        median = of_model(boards, model).groupby("set")[["sd", "predicted_robust", "radial_px", "tau"]].median()
        colour = COLOURS[model]
        left.plot(median.index, median["sd"], _MARKERS[model], color=colour, markersize=2.3, label=f"{name}: empirical")
        left.plot(median.index, median["predicted_robust"], color=colour, linewidth=1.0, label="predicted, robust")
        if model == WRONG:
            right.plot(
                median.index, median["radial_px"], "o", color=colour, markersize=2.3, label="radial effect, D(1,0)"
            )
            right.plot(median.index, median["tau"], color=INK, linestyle=":", label="tau: half of sigma")
    left.set_ylabel("standard deviation, px")
    right.set_ylabel("px")
    left.set_yticks([0.05, 0.1, 0.2, 0.5, 1.0], ["0.05", "0.1", "0.2", "0.5", "1"])
    right.set_yticks([0.01, 0.1, 1.0], ["0.01", "0.1", "1"])
    for axis in (left, right):
        axis.minorticks_off()
        axis.legend(loc="upper left")
    left.set_ylim(0.028, 3.0)
    return figure


@styled
def megadepth(images: pd.DataFrame) -> Figure:
    """Draw densities of z: all images, one that KS accepts under constant noise, and one that it rejects."""
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    accepted, rejected = examples(images)
    chosen_rows = [("all images", images)]
    chosen_rows += [
        (f"KS {word}: {label(row)}", row.to_frame().T) for word, row in (("accepts", accepted), ("rejects", rejected))
    ]
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    for axis, (title, rows) in zip(axes, chosen_rows, strict=True):
        axis.plot(middle, stats.norm.pdf(middle), color=INK, linewidth=0.8, linestyle=":", label="N(0, 1)")
        for noise in NOISES:
            density = density_of(rows, noise)
            style = {"color": _NOISE_COLOURS[noise], "linestyle": _NOISE_STYLES[noise]}
            axis.plot(middle, density, linewidth=1.0, label=f"{noise} noise", **style)
        axis.set(title=title, xlabel="standardised residual", xlim=(-4.0, 4.0))
    axes[0].set_ylabel("density")
    axes[0].legend(loc="upper left", handlelength=1.4)
    axes[0].set_ylim(0.0, 0.72)
    return figure


def density_of(rows: pd.DataFrame, noise: str) -> FloatArray:
    """Return the density (40,) of z under a noise model; every image counts alike."""
    counts = rows[histogram_columns(noise)].astype(float).dropna().to_numpy()
    counts = counts[counts.sum(axis=1) > 0]
    return np.asarray((counts / counts.sum(axis=1, keepdims=True)).mean(axis=0) / np.diff(EDGES))


def examples(images: pd.DataFrame, least: int = 100) -> tuple[pd.Series, pd.Series]:
    """Return, of the images with enough inliers, the ones with the median p of those accepted and of those rejected."""
    enough = images[(images["num_standardised"] >= min(least, images["num_standardised"].max()))]
    enough = enough.dropna(subset=["ks_constant_p", "ks_p"]).sort_values(["ks_constant_stat", "model", "image_id"])
    found = []
    for rejected in (False, True):
        part = enough[(enough["ks_constant_p"] < ALPHA) == rejected]
        part = part if len(part) else enough
        found.append(part.iloc[len(part) // 2])
    return found[0], found[1]


def label(row: pd.Series) -> str:
    """Name an image by model and id."""
    return f"{row['model']}, image {int(row['image_id'])}"
