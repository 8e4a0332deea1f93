"""How are the numbers of a run distributed over its images? As SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from sfm_audit.audit.table.words import Verdict
from sfm_audit.reports.charts.canvas import Axis, Chart, nothing, picture, words
from sfm_audit.reports.charts.numbers import bulk, cumulated, histogram

_WIDE: Final = 560.0
_BAR: Final = 22.0
_TOP: Final = 24.0
_NAMES: Final = 130.0
_SHOWN: Final = 4.0  # %; a number does not fit into less


def verdict_bars(counts: Mapping[str, Mapping[str, int]], label: str) -> Markup:
    """Draw one bar per question, split by verdict; counts: question -> verdict -> images."""
    body, width = [], _WIDE - _NAMES - 20.0
    x = _NAMES
    for verdict in Verdict:
        body.append(f'<rect class="bar {verdict}" x="{x:.0f}" y="4" width="12" height="10"/>')
        body.append(words(verdict, x + 16, 13, "small"))
        x += 100.0
    for i, (name, by) in enumerate(counts.items()):
        y, total, left = _TOP + i * _BAR, max(sum(by.values()), 1), _NAMES
        body.append(words(name, _NAMES - 6, y + 14, "name", anchor="end"))
        for verdict in Verdict:
            number = by.get(verdict, 0)
            wide = width * number / total
            box = f'x="{left:.1f}" y="{y + 2:.1f}" width="{wide:.1f}" height="{_BAR - 5:.0f}"'
            body.append(f'<rect class="bar {verdict}" {box}/>' if number else "")
            if 100.0 * number / total >= _SHOWN:
                middle, wanted = left + wide / 2.0, 7.0 * len(str(number)) + 4.0
                box = f'x="{middle - wanted / 2:.1f}" y="{y + 3.5:.1f}" width="{wanted:.1f}" height="14"'
                body.append(f'<rect class="plate {verdict}" {box}/>')
                body.append(words(number, middle, y + 14.5, f"on {verdict}", anchor="middle"))
            left += wide
    bottom = _TOP + len(counts) * _BAR + 2.0
    body += [words(f"{25 * k} %", _NAMES + width * k / 4, bottom + 12, "tick", anchor="middle") for k in range(5)]
    return picture("".join(body), (_WIDE, bottom + 18.0), label)


def histogram_by_verdict(
    values: Any,
    verdicts: Sequence[str],
    *,
    label: str,
    caption: str,
    log: bool = False,
    marks: Mapping[str, float] | None = None,
) -> Markup:
    """Draw the distribution of a number over images, stacked by verdict; ``marks``: thresholds by name."""
    found = histogram(values, verdicts, log=log)
    if found is None:
        return nothing(f"{label}: none computed", caption)
    total = np.sum(list(found.counts.values()), axis=0)
    x = Axis(float(found.edges[0]), float(found.edges[-1]), label, log=log)
    chart = Chart(x, Axis(0.0, 1.08 * float(total.max()), "images", whole=True), margin=(14.0, 10.0, 40.0, 36.0))
    base = np.zeros(len(total))
    for verdict, count in found.counts.items():
        chart.bars(found.edges, base, base + count, f"bar {verdict}")
        base = base + count
    for name, at in (marks or {}).items():
        chart.mark_x(at, name)
    missing = f", {found.missing} without the number" if found.missing else ""
    chart.title(f"{found.shown} images{missing}")
    chart.legend_above([(f"bar {verdict}", str(verdict)) for verdict in Verdict], y=30.0)
    return chart.svg(caption)


def noise_comparison(first: Any, second: Any, *, names: tuple[str, str], label: str, caption: str) -> Markup:
    """Draw the cumulative distributions of the same number under two noise models."""
    both = [np.asarray(values, dtype=np.float64) for values in (first, second)]
    known = np.concatenate([values[np.isfinite(values)] for values in both])
    if not known.size:
        return nothing(f"{label}: none computed", caption)
    low, high = bulk(known, log=False)
    chart = Chart(Axis(low, high, label), Axis(0.0, 100.0, "images at or below, %"))
    entries = []
    for values, name, look in zip(both, names, ("line vermilion dashed", "line blue"), strict=True):
        number, share = cumulated(values)
        if number.size:
            chart.line(number, share, look)
            entries.append((look, f"{name}: median {np.median(values[np.isfinite(values)]):.2g}"))
    chart.legend(entries, corner="bottom right")
    return chart.svg(caption)


def ks_comparison(constant: Any, chosen: Any, *, noise: str | None, alpha: float, caption: str) -> Markup:
    """Draw how often KS would reject at any level; a test of the right size follows the diagonal."""
    chart = Chart(Axis(0.0, 1.0, "p of Kolmogorov-Smirnov"), Axis(0.0, 100.0, "images with a smaller p, %"))
    chart.line([0.0, 1.0], [0.0, 100.0], "line muted")
    chart.mark_x(alpha, f"{alpha:g}", "ink dotted")
    entries = []
    for values, name, look in (
        (constant, "constant", "line vermilion dashed"),
        (chosen, noise or "chosen", "line blue"),
    ):
        p, share = cumulated(values)
        if not p.size or (values is chosen and noise == "constant"):
            continue
        every = np.asarray(values, dtype=np.float64)
        every = every[np.isfinite(every)]
        chart.line([0.0, *p, 1.0], [0.0, *share, 100.0], look)
        rejected = 100.0 * np.count_nonzero(every < alpha) / every.size
        entries.append((look, f"{name} noise: {rejected:.0f} % at {alpha:g}"))
    if not entries:
        return nothing("KS was not computed", caption)
    chart.legend(entries, corner="bottom right")
    return chart.svg(caption)
