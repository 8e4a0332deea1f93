"""What is wrong with a camera, by how much, and which of its parameters stand in for each other? As SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from markupsafe import Markup

from sfm_audit.reports.charts.canvas import WIDTH, nothing, picture, words
from sfm_audit.reports.charts.numbers import MISFIT_GROUPS

_TOO_LARGE_PX: Final = 1e100  # nor is NaN below it
_NAMES: Final = 92.0
_BAR: Final = 20.0
_CELL: Final = 34.0


def misfit_groups(row: Mapping[str, Any], *, tau_px: float | None, alpha: float, label: str) -> Markup:
    """Draw the systematic part of the residuals by group, from a row of ``RUN/images`` or ``RUN/cameras``.

    tau_px: effect that matters, drawn as a line.    alpha: groups with p above it are hollow.
    """
    size = [row[f"misfit_{group}_px"] for group in MISFIT_GROUPS]
    known = [value for value in size if value is not None and abs(value) < _TOO_LARGE_PX]
    if not known:
        return nothing("no group could be tested", label)
    tau = tau_px if tau_px is not None and 0 < tau_px < _TOO_LARGE_PX else None
    most = 1.2 * max(*known, tau or 0.05, 1e-300)
    width, top = WIDTH - _NAMES - 30.0, 20.0 if tau is not None else 4.0
    body = []
    for i, (group, value) in enumerate(zip(MISFIT_GROUPS, size, strict=True)):
        y = top + i * _BAR
        name = group.replace("_", " ")
        body.append(words(name, _NAMES - 6, y + 14, "name", anchor="end"))
        if value is None or not abs(value) < _TOO_LARGE_PX:
            why = "the model has it" if row.get(f"misfit_{group}_rank") == 0 else "not tested"
            body.append(words(why, _NAMES + 4, y + 14, "small quiet"))
            continue
        p = row[f"misfit_{group}_p"]
        look = "bar blue" if p is not None and p < alpha else "hollow blue"
        wide = width * max(value, 0.0) / most
        body.append(f'<rect class="{look}" x="{_NAMES}" y="{y + 3:.1f}" width="{wide:.1f}" height="{_BAR - 6:.0f}"/>')
        text = f"{value:.2f}" if 0.1 <= value < 1000 else f"{value:.2g}"
        body.append(words(text, _NAMES + wide + 4, y + 14, "small"))
    bottom = top + len(MISFIT_GROUPS) * _BAR
    body.append(f'<path class="axis" d="M{_NAMES} {top:.0f}V{bottom:.0f}"/>')
    if tau is not None:
        x = _NAMES + width * tau / most
        body.append(f'<path class="line vermilion dashed" d="M{x:.1f} {top - 4:.0f}V{bottom:.0f}"/>')
        body.append(words(f"matters above {tau:.2g}", x, 12, "small vermilion-ink", anchor="middle"))
    below = f"systematic residual, px RMS (hollow: p > {alpha:g})"
    body.append(words(below, WIDTH / 2, bottom + 16, "name", anchor="middle"))
    return picture("".join(body), (WIDTH, bottom + 22.0), label)


def correlations(names: Sequence[str], lower: Sequence[float | None], *, label: str) -> Markup:
    """Draw a triangle of correlations; ``lower``: below the diagonal, row by row, null where not identified."""
    n = len(names)
    if n < 2:
        return nothing("fewer than two own parameters", label)
    left = 8.0 + 6.4 * max(map(len, names))
    body, at = [], iter(lower)
    for i in range(1, n):
        y = 4.0 + (i - 1) * _CELL
        body.append(words(names[i], left - 6, y + 21, "name", anchor="end"))
        for j in range(i):
            value = next(at, None)
            known = value is not None and math.isfinite(value)
            x = left + j * _CELL
            box = f'x="{x:.0f}" y="{y:.0f}" width="{_CELL - 2:.0f}" height="{_CELL - 2:.0f}"'
            share = min(abs(value), 1.0) if value is not None and known else 0.0
            look = "cell-plus" if known and value is not None and value >= 0 else "cell-minus"
            body.append(f'<rect class="axis" {box}/><rect class="{look}" fill-opacity="{0.75 * share:.2f}" {box}/>')
            text = f"{value:+.2f}".replace("-", "\u2212") if value is not None and known else "-"
            body.append(words(text, x + _CELL / 2 - 1, y + 20, "small", anchor="middle"))
    bottom = 4.0 + (n - 1) * _CELL
    body += [
        words(names[j], left + j * _CELL + _CELL / 2 - 1, bottom + 13, "name", anchor="middle") for j in range(n - 1)
    ]
    return picture("".join(body), (max(WIDTH, left + n * _CELL), bottom + 20.0), label)
