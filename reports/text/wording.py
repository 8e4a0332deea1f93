"""How do numbers, names and lists look in a terminal? The same everywhere, and safe with any name."""

from __future__ import annotations

import math
import re
import textwrap
from typing import Any

from rich.cells import cell_len

MISSING = "-"


def plain(text: str) -> str:
    """Show control characters, line ends and directional marks by their codes: a name stays on its line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in text)


def shorten(text: str, width: int) -> str:
    """Cut the middle out of a long name; its two ends tell names apart."""
    if cell_len(text) <= width:
        return text
    head, tail = "", ""
    for left, right in zip(text, reversed(text), strict=True):
        if cell_len(head + tail) + cell_len(right) + 3 > width:
            break
        tail = right + tail
        if cell_len(head + tail) + cell_len(left) + 3 > width:
            break
        head += left
    return f"{head}...{tail}"


def px(value: float | None) -> str:
    """Return a length in pixels with three decimals; large ones with three digits."""
    if value is None:
        return MISSING
    return f"{value:.3f}" if abs(value) < 1000 else f"{value:.3g}"


def number(value: float | None, digits: int = 2) -> str:
    """Return a pure number; large ones with three digits."""
    if value is None:
        return MISSING
    return f"{value:.{digits}f}" if abs(value) < 1000 else f"{value:.3g}"


def probability(value: float | None) -> str:
    """Return a p-value with two digits."""
    if value is None:
        return MISSING
    return f"{value:.2g}" if value >= 1e-3 or value == 0 else re.sub(r"e-0?", "e-", f"{value:.0e}")


def counted(count: int, what: str) -> str:
    """Return '1 image', '2 images'."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def paragraph(text: str, width: int, indent: str = "") -> str:
    """Wrap a text; the lines after the first are indented."""
    return textwrap.fill(text, width, subsequent_indent=indent, break_on_hyphens=False)


def natural_key(*parts: Any) -> tuple[tuple[tuple[int, float, str], ...], ...]:
    """Return a sort key under which scene 9 comes before scene 10."""
    return tuple(_natural(str(part)) for part in parts)


def _natural(text: str) -> tuple[tuple[int, float, str], ...]:
    pieces = re.findall(r"[0-9]+|[^0-9]+", text)
    return tuple((0, _as_number(piece), piece) if piece[0] in "0123456789" else (1, 0.0, piece) for piece in pieces)


def _as_number(digits: str) -> float:
    return float(digits) if len(digits) < 300 else math.inf
