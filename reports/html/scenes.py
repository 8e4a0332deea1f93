"""The scene on the page: cameras from above and from the side, and which images share points, per model."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from PIL import Image

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.reports.charts.scene import SceneView, place, side_view, strongest_pairs, top_view
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.wording import natural_key, plain

MAX_VIEWS: Final = 12
MAX_VIEWED_IMAGES: Final = 10_000  # of all views together
_LONG: Final = 200.0  # units: a scene that both views show as a strip has the width of the page
_NEIGHBOURS: Final = 12  # of each image, kept for a click
_LINKS: Final = 2  # of each image, drawn at once
_MATRIX: Final = 240  # cells along a side
_CIVIDIS: Final = ((0, 32, 77), (64, 77, 107), (124, 123, 120), (188, 174, 108), (255, 234, 70))


@dataclass(frozen=True, slots=True, eq=False)
class ModelView:
    """A model that is shown. part: of its rows.    view: None where it could not be read, and ``missing`` says why."""

    part: str
    title: str
    view: SceneView | None
    missing: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DrawnView:
    """A model on the page. data: what the script needs to answer a click, as JSON holds it.    long: a strip."""

    title: str
    missing: str | None
    top: Markup | None = None
    side: Markup | None = None
    matrix: str | None = None
    caption: str = ""
    outside: int = 0
    num_images: int = 0
    num_alone: int = 0
    long: bool = False
    data: Mapping[str, Any] | None = None


def draw_view(shown: ModelView, rows: Sequence[Row]) -> DrawnView:
    """Draw a model; ``rows``: of the page's table, whose position is the number of a row."""
    view = shown.view
    if view is None:
        return DrawnView(shown.title, shown.missing)
    row_of = {row["image_id"]: i for i, row in enumerate(rows) if row["part"] == shown.part}
    at = [row_of.get(image_id, -1) for image_id in view.image_id.tolist()]
    verdicts = [rows[i]["verdict"] if i >= 0 else None for i in at]
    placed = place(view)
    links = strongest_pairs(view, _LINKS)
    words = f"{len(view)} cameras of {shown.title}"
    alone = len(view) - len(np.unique(view.pairs))
    return DrawnView(
        shown.title,
        None,
        top_view(placed, verdicts, links, f"{words} from above, coloured by verdict"),
        side_view(placed, verdicts, f"{words} from the side, coloured by verdict"),
        _matrix_url(view, rows, at) if len(view.pairs) else None,
        _caption(view),
        int(placed.outside.sum()),
        len(view),
        alone,
        max(placed.heights) < _LONG,
        {
            "rows": at,
            "top": _numbers(placed.top),
            "side": _numbers(placed.side),
            "near": _nearest(view),
        },
    )


def _numbers(places: FloatArray) -> list[float | None]:
    """Tenths of a unit; null where a camera stands nowhere."""
    return [value if math.isfinite(value) else None for value in np.round(places, 1).ravel().tolist()]


def _caption(view: SceneView) -> str:
    if not len(view.pairs):
        return "No two images share a point."
    most = int(view.shared.max())
    sample = "" if view.share >= 1.0 else f" (counted on one of {round(1.0 / view.share)} points)"
    return (
        f"Points that two images share{sample}, images in order of their names along both sides; "
        f"brightest: {most}. Blocks that nothing joins are parts that drift against each other."
    )


def _nearest(view: SceneView) -> list[list[int]]:
    """Per image: how many images share points with it, then the strongest of them and their counts, in turns."""
    both = np.concatenate([view.pairs, view.pairs[:, ::-1]])
    shared = np.concatenate([view.shared, view.shared])
    order = np.lexsort((-shared, both[:, 0]))
    starts = np.searchsorted(both[order, 0], np.arange(len(view) + 1))
    out = []
    for first, last in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        best = order[first : min(last, first + _NEIGHBOURS)]
        counts = np.column_stack([both[best, 1], shared[best]]).ravel()
        out.append([last - first, *counts.tolist()])
    return out


def _matrix_url(view: SceneView, rows: Sequence[Row], at: Sequence[int]) -> str:
    """Return the counts of shared points as a picture: the brighter the more, on a logarithmic scale."""
    names = [natural_key(str(rows[i]["image_name"])) if i >= 0 else () for i in at]
    order = sorted(range(len(view)), key=lambda i: (at[i] < 0, names[i]))
    rank = np.empty(len(view), dtype=np.int64)
    rank[order] = np.arange(len(view))
    size = min(len(view), _MATRIX)
    cell: IntArray = rank * size // len(view)
    grid = np.zeros((size, size), dtype=np.int64)
    i, j = cell[view.pairs].T
    np.maximum.at(grid, (i, j), view.shared)
    np.maximum.at(grid, (j, i), view.shared)
    share = np.log1p(grid) / np.log1p(grid.max())
    stops = np.linspace(0.0, 1.0, len(_CIVIDIS))
    colours = np.stack([np.interp(share, stops, [stop[k] for stop in _CIVIDIS]) for k in range(3)], axis=-1)
    content = BytesIO()
    image = Image.fromarray(colours.round().astype(np.uint8))
    zoom = max(1, _MATRIX * 2 // size)
    image.resize((size * zoom, size * zoom), Image.Resampling.NEAREST).quantize(64).save(
        content, format="png", optimize=True
    )
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"


def chosen_models(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Return part, location and title of the models to show: those with the worst images first."""
    found: dict[str, tuple[str, str]] = {}
    counts: dict[str, int] = {}
    for row in rows:
        found.setdefault(row["part"], (row["model_path"], plain(f"{row['scene']}/{row['component']}")))
        counts[row["part"]] = counts.get(row["part"], 0) + 1
    chosen: list[tuple[str, str, str]] = []
    total = 0
    for part, (path, title) in found.items():
        total += counts[part]
        if len(chosen) == MAX_VIEWS or (chosen and total > MAX_VIEWED_IMAGES):
            break
        chosen.append((part, path, title))
    return chosen
