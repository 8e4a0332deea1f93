"""The page's figures: SVG, one look, colours that the colour-blind can tell apart (Okabe and Ito)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from scripts.validation.bounds import Tables, cells, tested_share
from scripts.validation.rules import SCORES, curve, rules
from scripts.validation.truth import CAMERA_DEFECTS, SOUND, TAU_PX
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.simulate.noise import NoiseKind

_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MARKERS: Final = ("o", "s", "^", "v", "D", "P", "X")
_GREY: Final = "#B8B8B8"
_WIDTH: Final = 7.2  # inches: a page's text width
_STYLE: Final = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial"],
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "figure.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "validation",
}
_LEVEL_NAMES: Final = {
    "ks": "ks",
    "ks_fitted": "ks_fitted",
    "ks_norm": "ks_norm",
    "dap": "dap (D'Agostino)",
    "sw": "sw (Shapiro-Wilk)",
    "ks_constant": "ks under constant noise",
}


def draw_figures(tables: Tables, folder: Path, suffix: str = "svg") -> list[Path]:
    """Draw all figures into a folder; needs matplotlib (``pip install -e .[study]``)."""
    matplotlib = importlib.import_module("matplotlib")
    matplotlib.use("Agg")
    plt = importlib.import_module("matplotlib.pyplot")
    folder.mkdir(parents=True, exist_ok=True)
    scenes = tables["scenes"]
    quarter = scenes[scenes["design"] == "quarter"]
    paths = []
    with matplotlib.rc_context(_STYLE):
        for name, figure in (
            ("size", _misfit_size(plt, tables["singles"])),
            ("goodness_of_fit", _goodness_of_fit(plt, scenes[scenes["design"] == "size"])),
            ("power", _power(plt, tables["power"], quarter)),
            ("joint", _joint(plt, quarter)),
            ("rules", _rules(plt, quarter)),
        ):
            paths.append(folder / f"validation_{name}.{suffix}")
            figure.savefig(paths[-1], metadata={"Date": None} if suffix == "svg" else None, dpi=110)
            plt.close(figure)
    return paths


def _rates(frame: pd.DataFrame, noise: NoiseKind, column: str) -> tuple[list[int], list[float]]:
    """Where the test ran: n, and the share with p < 5 % in per cent."""
    found = [(n, tested_share(part, column)) for kind, n, part in cells(frame) if kind is noise]
    kept = [(n, 100.0 * float(hits.mean())) for n, hits in found if hits is not None]
    return [n for n, _ in kept], [rate for _, rate in kept]


def _panels(plt: Any, names: Sequence[str], height: float) -> tuple[Any, list[Any]]:
    figure, axes = plt.subplots(2, 3, figsize=(_WIDTH, height), sharex=True, sharey=True, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=True):
        axis.set_title(name, loc="left")
        axis.set_xscale("log")
        axis.set_xticks([25, 100, 600, 5000], ["25", "100", "600", "5000"])
        axis.minorticks_off()
    for axis in axes[1]:
        axis.set_xlabel("points per image")
    return figure, list(axes.flat)


def _noise_legend(figure: Any, axis: Any) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)


def _lines(axis: Any, frame: pd.DataFrame, column: str) -> None:
    for noise, colour, marker in zip(NoiseKind, _COLOURS, _MARKERS, strict=True):
        axis.plot(*_rates(frame, noise, column), color=colour, marker=marker, label=str(noise).replace("_", " "))


def _misfit_size(plt: Any, singles: pd.DataFrame) -> Any:
    figure, axes = _panels(plt, [str(group).replace("_", " ") for group in GROUPS], 4.2)
    for axis, group in zip(axes, GROUPS, strict=True):
        axis.fill_between([50, 5000], 1.5, 7.0, color="#EFEFEF", linewidth=0)
        axis.plot([22, 50], [8.0, 8.0], color=_GREY, linewidth=0.8)
        axis.axhline(5.0, color=_GREY, linewidth=0.8)
        _lines(axis, singles, f"misfit_{group}_p")
        axis.set_ylim(0.0, 10.0)
    figure.supylabel("correct cameras with p < 5 %, %", fontsize=8.0)
    _noise_legend(figure, axes[0])
    return figure


def _goodness_of_fit(plt: Any, scenes: pd.DataFrame) -> Any:
    figure, axes = _panels(plt, list(_LEVEL_NAMES.values()), 4.2)
    for axis, test in zip(axes, _LEVEL_NAMES, strict=True):
        axis.axhline(5.0, color=_GREY, linewidth=0.8)
        _lines(axis, scenes, f"{test}_p")
        axis.set_yscale("symlog", linthresh=5.0, linscale=0.8)
        axis.set_ylim(0.0, 110.0)
        axis.set_yticks([0, 5, 10, 30, 100], ["0", "5", "10", "30", "100"])
        axis.minorticks_off()
    figure.supylabel("correct cameras with p < 5 %, %", fontsize=8.0)
    _noise_legend(figure, axes[0])
    return figure


def _power(plt: Any, power: pd.DataFrame, quarter: pd.DataFrame) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(_WIDTH, 3.2), sharey=True, layout="constrained")
    singles, edges = power[power["n"] == 250], np.array([0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.2])
    own_edges = np.array([0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8, 1.2])
    for axis, frame, limits, title in (
        (axes[0], singles, edges, "single images, 250 points"),
        (axes[1], quarter[quarter["kind"] != SOUND], own_edges, "scenes, a quarter wrong, 400 points"),
    ):
        axis.axvline(TAU_PX, color=_GREY, linewidth=0.8)
        axis.annotate("tau", (TAU_PX, 101.5), color="#606060", ha="center", fontsize=7.5)
        for kind, colour, marker in zip(CAMERA_DEFECTS, _COLOURS, _MARKERS, strict=False):
            own = frame[frame["kind"] == str(kind)]
            label = str(kind).replace("_", " ")
            _binned(axis, own, limits, own["verdict_misfit"] == "rejected", color=colour, marker=marker, label=label)
        style = {"color": "#000000", "linestyle": ":", "label": "ks, all kinds"}
        _binned(axis, frame, limits, frame["verdict_ks"] == "rejected", **style)
        axis.set_xscale("log")
        axis.set_xticks([0.05, 0.1, 0.2, 0.5, 1.0], ["0.05", "0.1", "0.2", "0.5", "1"])
        axis.minorticks_off()
        axis.set_xlim(limits[0], limits[-1])
        axis.set_xlabel("true systematic error, px RMS")
        axis.set_title(title, loc="left", pad=12)
    axes[0].set_ylabel("rejected by verdict_misfit, %")
    axes[0].set_ylim(-2.0, 101.0)
    _noise_legend(figure, axes[0])
    return figure


def _binned(axis: Any, frame: pd.DataFrame, edges: np.ndarray, hits: pd.Series, **style: object) -> None:
    """Share of hits between edges, at the geometric middle."""
    place = np.digitize(frame["true_px"], edges) - 1
    rates = [100.0 * float(hits[place == k].mean()) if (place == k).any() else np.nan for k in range(len(edges) - 1)]
    axis.plot(np.sqrt(edges[1:] * edges[:-1]), rates, **style)


def _joint(plt: Any, quarter: pd.DataFrame) -> Any:
    figure, axes = plt.subplots(2, 2, figsize=(_WIDTH, 3.6), sharex=True, layout="constrained")
    sound = quarter["kind"] == SOUND
    edges = np.linspace(0.0, 1.2, 61)
    for column, (name, title) in enumerate((("effect_alone_px", "image by image"), ("effect_joint_px", "joint test"))):
        for row, (chosen, label, colour) in enumerate(
            ((sound, "correct cameras", _COLOURS[0]), (~sound, "wrong cameras", _COLOURS[1]))
        ):
            axis = axes[row][column]
            effect = quarter.loc[chosen, name]
            seen = effect[effect > 0]
            axis.hist(np.minimum(seen, edges[-1] - 1e-9), edges, color=colour, linewidth=0)
            axis.axvline(TAU_PX, color="#606060", linewidth=0.8, linestyle="--")
            text = f"{label}\nno significant group: {100.0 * float((effect == 0).mean()):.1f} %"
            above = f"\nabove tau: {100.0 * float((effect > TAU_PX).mean()):.1f} %"
            axis.annotate(text + above, (0.98, 0.95), xycoords="axes fraction", ha="right", va="top", fontsize=7.5)
            if row == 0:
                axis.set_title(title, loc="left")
                axis.set_ylim(0.0, max(10.0, 1.6 * axis.dataLim.y1))
    for axis in axes[1]:
        axis.set_xlabel("largest effect among significant groups, px")
        top = max(float(other.dataLim.y1) for other in axes[1])
        axis.set_ylim(0.0, 1.45 * top)
    for axis in axes[:, 0]:
        axis.set_ylabel("images")
    return figure


def _rules(plt: Any, quarter: pd.DataFrame) -> Any:
    figure, axis = plt.subplots(figsize=(_WIDTH, 3.6), layout="constrained")
    for (column, name), colour in zip(SCORES.items(), _COLOURS, strict=False):
        alarms, detections, _ = curve(quarter, column)
        axis.plot(100.0 * alarms, 100.0 * detections, color=colour, label=f"{name}, every threshold")
    points = [rule for rule in rules(quarter) if rule.cannot_say < 1.0 and rule.rejects.notna().all()]
    sound = quarter["kind"] == SOUND
    for rule, marker in zip(points, (*_MARKERS, "*", "<", ">", "p", "h"), strict=False):
        label = f"{rule.name}, {rule.threshold}" if rule.threshold else rule.name
        alarm, detection = (100.0 * float(rule.rejects[chosen].mean()) for chosen in (sound, ~sound))
        style = {"marker": marker, "linestyle": "none", "markersize": 6.0}
        axis.plot(alarm, detection, color="#000000", markerfacecolor="white", label=label, clip_on=False, **style)
    diagonal = np.linspace(0.0, 100.0, 501)
    axis.plot(diagonal, diagonal, color=_GREY, linewidth=0.8)
    axis.set_xscale("symlog", linthresh=2.0, linscale=0.6)
    axis.set_xticks([0, 1, 2, 5, 10, 20, 50, 100], ["0", "1", "2", "5", "10", "20", "50", "100"])
    axis.minorticks_off()
    axis.set_xlim(-0.15, 100.0)
    axis.set_ylim(-2.0, 101.0)
    axis.set_xlabel("correct cameras rejected, %")
    axis.set_ylabel("wrong cameras rejected, %")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center")
    return figure
