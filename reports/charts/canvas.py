"""How is a chart written as SVG? Axes, ticks, lines, bars and arrows; colours are the page's variables (CSS classes).

Numbers are rounded to a tenth of a unit of the drawing, about a tenth of a pixel on the page.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from markupsafe import Markup, escape

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.charts.numbers import log_ticks, tick_label, ticks

WIDTH: Final = 380.0
HEIGHT: Final = 290.0
_LETTER: Final = 5.8  # mean width of a letter of 11 units
_FAR: Final = 1e5  # what lies farther out is cut: browsers draw wrongly from 1e7 on
_ROW: Final = 15.0


@dataclass(frozen=True, slots=True)
class Axis:
    """A range of numbers on a side of the chart.

    marks: where numbers stand, by default at round ones.    whole: whether they count something.
    """

    low: float
    high: float
    label: str = ""
    log: bool = False
    marks: tuple[tuple[float, str], ...] | None = None
    whole: bool = False

    def share(self, values: Any) -> FloatArray:
        """Return where values lie, 0 at the low and 1 at the high end."""
        low, high = np.longdouble(self.low), np.longdouble(self.high)  # a range may be as wide as all doubles
        number = np.asarray(values, dtype=np.longdouble)
        if self.log:
            with np.errstate(divide="ignore", invalid="ignore"):
                low, high, number = np.log(low), np.log(high), np.log(number)
        return np.asarray((number - low) / (high - low if high != low else 1.0), dtype=np.float64)

    @property
    def ticks(self) -> Iterable[tuple[float, str]]:
        """Places and texts of the numbers on the axis."""
        if self.marks is not None:
            return self.marks
        found = (log_ticks if self.log else ticks)(self.low, self.high)
        return [(at, tick_label(at)) for at in found if not self.whole or at.is_integer()]


class Chart:
    """One pair of axes and what is drawn on them, from back to front.

    Parameters
    ----------
    x, y : axes; ``y`` grows upwards unless its low end is the larger number
    size : of the drawing, width and height, units
    margin : left, right, top, bottom, units; the left one grows with the labels of ``y``
    frame : whether to draw all four sides
    """

    def __init__(
        self,
        x: Axis,
        y: Axis,
        *,
        size: tuple[float, float] = (WIDTH, HEIGHT),
        margin: tuple[float, float, float, float] = (14.0, 10.0, 22.0, 36.0),
        frame: bool = False,
    ) -> None:
        self._x, self._y = x, y
        self._width, self._height = size
        left, right, top, bottom = margin
        widest = max((len(text) for _, text in y.ticks), default=0)
        left += widest * _LETTER + (16.0 if y.label else 0.0)
        self._box = (left, top, max(size[0] - left - right, 1.0), max(size[1] - top - bottom, 1.0))
        self._back: list[str] = []
        self._front: list[str] = []
        self._notes: list[str] = []
        self._draw_axes(frame=frame)

    def place(self, x: Any, y: Any) -> FloatArray:
        """Return (n, 2) positions in the drawing."""
        left, top, width, height = self._box
        with np.errstate(over="ignore", invalid="ignore"):  # what is out of all bounds stands far away
            out = np.column_stack([left + width * self._x.share(x), top + height * (1.0 - self._y.share(y))])
        return np.clip(np.nan_to_num(out, nan=-_FAR, posinf=_FAR, neginf=-_FAR), -_FAR, _FAR)

    def line(self, x: Any, y: Any, look: str) -> None:
        """Draw a line; ``look``: CSS classes."""
        self._front.append(f'<path class="{look}" d="{path(self.place(x, y))}"/>')

    def band(self, x: Any, low: Any, high: Any, look: str) -> None:
        """Fill between two lines."""
        edge = np.concatenate([self.place(x, low), self.place(x, high)[::-1]])
        self._front.append(f'<path class="{look}" d="{path(edge)}Z"/>')

    def bars(self, edges: FloatArray, low: Any, high: Any, look: str) -> None:
        """Draw bars over the bins between ``edges`` (n + 1,), from ``low`` to ``high`` (n,) each."""
        at = self.place(edges, np.full(len(edges), self._y.low))[:, 0]
        bottom, top = (self.place(edges[:-1], np.broadcast_to(v, len(edges) - 1))[:, 1] for v in (low, high))
        parts = [
            f"M{a:.1f} {b:.1f}V{t:.1f}H{c:.1f}V{b:.1f}Z"
            for a, c, b, t in zip(at[:-1].tolist(), at[1:].tolist(), bottom.tolist(), top.tolist(), strict=True)
            if b - t > 0.02
        ]
        self._front.append(f'<path class="{look}" d="{"".join(parts)}"/>')

    def dots(self, x: Any, y: Any, look: str, *, radius: float = 1.6) -> None:
        """Draw points as discs: lines without length with round ends."""
        at = self.place(x, y)
        d = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in at.tolist())
        self._front.append(f'<path class="dot {look}" stroke-width="{2 * radius:g}" d="{d}"/>')

    def arrows(self, start: FloatArray, end: FloatArray, look: str, *, head: float = 3.2) -> None:
        """Draw arrows from ``start`` to ``end``, (n, 2) each in the numbers of the axes."""
        a, b = self.place(*start.T), self.place(*end.T)
        self._front.append(f'<path class="arrow {look}" d="{arrow_path(a, b, head)}"/>')

    def mark_x(self, value: float, text: str, look: str = "ink dashed") -> None:
        """Draw a threshold as a vertical line, and say at its top what it is."""
        left, top, width, height = self._box
        x = float(np.clip(left + width * self._x.share(value), -_FAR, _FAR))
        if not left - 1.0 <= x <= left + width + 1.0:
            return
        self._front.append(f'<path class="line {look}" d="M{x:.1f} {top:.1f}v{height:.1f}"/>')
        anchor = "start" if x < left + width / 2.0 else "end"
        shift = 4.0 if anchor == "start" else -4.0
        self._notes.append(words(text, x + shift, top + 9, "small", anchor=anchor))

    def level(self, value: float, look: str = "muted") -> None:
        """Draw a horizontal line."""
        self.line([self._x.low, self._x.high], [value, value], f"line {look}")

    def text(self, x: float, y: float, text: str, *, anchor: str = "start", look: str = "small") -> None:
        """Write at a place given in the numbers of the axes."""
        a, b = self.place([x], [y])[0].tolist()
        self._notes.append(words(text, a, b + 4, look, anchor=anchor))

    def raw(self, element: str) -> None:
        """Draw an SVG element that the caller has written, in the units of the drawing."""
        self._front.append(element)

    def title(self, text: str) -> None:
        """Write above the axes."""
        self._notes.append(words(text, 2, 13, "title"))

    def legend(self, entries: Sequence[tuple[str, str]], *, corner: str = "top right") -> None:
        """Say what the looks mean, (look, text) each; a look that begins with ``line`` is a line, else a patch."""
        left, top, width, height = self._box
        longest = max(len(text) for _, text in entries) * _LETTER * 0.94 + 24.0
        x = left + 6.0 if "left" in corner else left + width - longest
        y = top + 8.0 if "top" in corner else top + height - _ROW * len(entries)
        for i, (look, text) in enumerate(entries):
            at = y + i * _ROW
            sign = (
                f'<path class="{look}" d="M{x:.1f} {at:.1f}h16"/>'
                if look.startswith("line")
                else f'<rect class="{look}" x="{x + 2:.1f}" y="{at - 5:.1f}" width="12" height="10"/>'
            )
            self._notes.append(sign + words(text, x + 20, at + 4, "small"))

    def legend_above(self, entries: Sequence[tuple[str, str]], y: float = 13.0, x: float = 2.0) -> None:
        """Say what the looks mean in one line above the axes."""
        for look, text in entries:
            self._notes.append(f'<rect class="{look}" x="{x:.1f}" y="{y - 9:.1f}" width="12" height="10"/>')
            self._notes.append(words(text, x + 16, y, "small"))
            x += 28.0 + len(text) * _LETTER

    def svg(self, label: str) -> Markup:
        """Return the picture; ``label`` says what it shows to those who do not see it."""
        left, top, width, height = self._box
        inner = "".join(self._front)  # in a viewport of its own, which cuts what is outside without an id
        clipped = (
            f'<svg x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'viewBox="{left:.1f} {top:.1f} {width:.1f} {height:.1f}" aria-hidden="true">{inner}</svg>'
        )
        body = "".join([*self._back, clipped, *self._notes])
        return picture(body, (self._width, self._height), label)

    def _draw_axes(self, *, frame: bool) -> None:
        left, top, width, height = self._box
        outline = f"M{left:.1f} {top:.1f}v{height:.1f}h{width:.1f}" + (f"v{-height:.1f}Z" if frame else "")
        self._back.append(f'<path class="axis" d="{outline}"/>')
        bottom = top + height
        for value, text in self._x.ticks:
            x = left + width * float(self._x.share(value))
            self._back.append(f'<path class="axis" d="M{x:.1f} {bottom:.1f}v3"/>')
            self._back.append(words(text, x, bottom + 14, "tick", anchor="middle"))
        for value, text in self._y.ticks:
            y = bottom - height * float(self._y.share(value))
            self._back.append(f'<path class="axis" d="M{left:.1f} {y:.1f}h-3"/>')
            self._back.append(words(text, left - 5, y + 4, "tick", anchor="end"))
        if self._x.label:
            x, y = left + width / 2.0, bottom + 30.0
            self._back.append(words(self._x.label, x, y, "name", anchor="middle"))
        if self._y.label:
            y = top + height / 2.0
            name = words(self._y.label, 0, 0, "name", anchor="middle")
            self._back.append(f'<g transform="translate(11 {y:.1f}) rotate(-90)">{name}</g>')


def words(text: object, x: float, y: float, look: str, *, anchor: str = "start") -> str:
    """Return a text in a drawing, escaped; ``look``: CSS classes."""
    at = f'x="{x:.1f}" y="{y:.1f}"' + ("" if anchor == "start" else f' text-anchor="{anchor}"')
    return f'<text class="{look}" {at}>{escape(text)}</text>'


def path(at: FloatArray) -> str:
    """Return a line through (n, 2) positions as path data."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in at.tolist()) if len(at) else ""


def arrow_path(start: FloatArray, end: FloatArray, head: float) -> str:
    """Return arrows between (n, 2) positions as path data; short ones have short heads."""
    along = end - start
    length = np.hypot(*along.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = np.where(length[:, None] > 0, along / length[:, None], 0.0)
    size = np.minimum(head, 0.6 * length)[:, None]
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    wings = [end - size * (unit + sign * 0.5 * across) for sign in (1.0, -1.0)]
    table = np.column_stack([start, end, wings[0], wings[1]])
    return "".join(
        f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}M{e:.1f} {f:.1f}L{c:.1f} {d:.1f} {g:.1f} {h:.1f}"
        for a, b, c, d, e, f, g, h in table.tolist()
    )


def picture(body: str, size: tuple[float, float], label: str) -> Markup:
    """Return an SVG element around ``body``, which the caller has escaped."""
    return Markup(  # noqa: S704 - numbers, and texts that were escaped where they were put in
        f'<svg class="chart" role="img" aria-label="{escape(label)}" viewBox="0 0 {size[0]:g} {size[1]:g}">{body}</svg>'
    )


def nothing(why: str, label: str, size: tuple[float, float] = (WIDTH, 110.0)) -> Markup:
    """Return, in place of a picture, why there is none."""
    return picture(words(why, size[0] / 2, size[1] / 2, "name", anchor="middle"), size, label)
