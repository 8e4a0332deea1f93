"""How does a figure become part of a page? As SVG with the page's colours, so that it follows light and dark."""

from __future__ import annotations

import base64
import re
from io import BytesIO, StringIO
from typing import Final

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from sfm_audit.reports.figures import style

_VARIABLES: Final = {
    style.BLUE: "--blue",
    style.VERMILION: "--vermilion",
    style.GREEN: "--green",
    style.AMBER: "--amber",
    style.INK: "--ink",
    style.MUTED: "--muted",
    style.GRID: "--grid",
    "#ffffff": "--paper",
}
_COLOUR: Final = re.compile("|".join(map(re.escape, _VARIABLES)), re.IGNORECASE)
_PREAMBLE: Final = re.compile(r"^.*?(?=<svg\b)", re.DOTALL)
_REMOVED: Final = re.compile(r"<metadata>.*?</metadata>|<style\b.*?</style>|<!--.*?-->", re.DOTALL)
_GROUP_ID: Final = re.compile(r'(?<=<g) id="[^"]*"')
_SIZE: Final = re.compile(r' (?:width|height)="[0-9.]+pt"')
_FONTS: Final = re.compile(r"'DejaVu Sans'(?:, [^;\"]*)?(?=[;\"])")
_DIGITS: Final = re.compile(r"(?<=\d\.\d\d)\d+")
_BLANKS: Final = re.compile(r"\s*\n\s*")


def to_svg(figure: Figure, *, key: str, label: str) -> Markup:
    """Return a figure as an inline SVG element.

    Parameters
    ----------
    key : unique on the page: ids inside the picture are made from it
    label : what the picture shows, for those who do not see it
    """
    text = StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": key}), np.errstate(all="ignore"):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = _REMOVED.sub("", _PREAMBLE.sub("", text.getvalue(), count=1))
    svg = _DIGITS.sub("", _FONTS.sub("sans-serif", _GROUP_ID.sub("", svg)))
    svg = _COLOUR.sub(lambda match: f"var({_VARIABLES[match[0].lower()]})", svg)
    head, rest = svg.split(">", 1)
    head = _SIZE.sub("", head).replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1)
    return Markup(_BLANKS.sub(" ", f"{head}>{rest}"))  # noqa: S704 - matplotlib escapes text, `escape` the label


def to_jpeg_url(figure: Figure, *, dpi: float = 150.0) -> str:
    """Return a figure that holds a photo as a data URL."""
    content = BytesIO()
    figure.savefig(content, format="jpeg", dpi=dpi, pil_kwargs={"quality": 80, "optimize": True})
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"
