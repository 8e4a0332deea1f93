"""Where do the cameras of a model stand, who sees the same points, and which of them are rejected? As SVG.

The axes of the views are the principal axes of points and cameras. Up is the one that is nearest to the cameras' own
up; where none is near, it is theirs, and where they do not agree on one, the shortest axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from markupsafe import Markup, escape

from sfm_audit.audit.table.words import Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.reports.charts.canvas import picture

WIDTH: Final = 560.0
_HEIGHTS: Final = (150.0, 460.0)
_EDGE: Final = 12.0
_MIN_AGREEMENT: Final = 0.3  # length of the mean of the cameras' unit vectors up
_NEAR_UP: Final = 0.9  # cosine: a principal axis this near to the cameras' up is up, else theirs is
_MAX_PLACE: Final = 1e100  # model units
_FAR_OUT: Final = 1.5  # times the extent of the bulk, beyond which a camera is drawn at the border


@dataclass(frozen=True, slots=True, eq=False)
class SceneView:
    """The cameras of one model, as a model or a table says; row i of every array is the same image.

    image_id: (n,).    centre, ahead, up: (n, 3) world, model units; directions have length 1.
    points: (k, 3) a sample of the points.
    pairs: (m, 2) rows of images that share points, each pair once.    shared: (m,) how many points.
    share: of the points that were counted; 1 where all were.
    """

    image_id: IntArray
    centre: FloatArray
    ahead: FloatArray
    up: FloatArray
    points: FloatArray
    pairs: IntArray
    shared: IntArray
    share: float = 1.0

    def __len__(self) -> int:
        return len(self.image_id)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A model on paper. top, side: (n, 2) places of cameras, units of the drawing.    heights: of the two views.

    points_top, points_side: (k, 2).    ahead_top, ahead_side: (n, 2) directions, shorter where they leave the paper.
    outside: (n,) cameras far off, drawn at the border.
    """

    top: FloatArray
    side: FloatArray
    heights: tuple[float, float]
    points_top: FloatArray
    points_side: FloatArray
    ahead_top: FloatArray
    ahead_side: FloatArray
    outside: BoolArray


def place(view: SceneView) -> Placed:
    """Return where cameras and points stand in the top and in the side view; both share the horizontal axis."""
    view = _drawable(view)
    axes = principal_axes(view)
    cameras, points, ahead = (values @ axes.T for values in (view.centre, view.points, view.ahead))
    low, high, outside = _bounds(cameras, points)
    extent = high - low
    room = WIDTH - 2 * _EDGE
    scale = min(room / extent[0], (_HEIGHTS[1] - 2 * _EDGE) / max(extent[1], extent[2]))
    heights = [float(np.clip(scale * extent[k] + 2 * _EDGE, *_HEIGHTS)) for k in (1, 2)]
    middle = (low + high) / 2.0

    def paper(values: FloatArray, axis: int) -> FloatArray:
        height = heights[axis - 1]
        x = WIDTH / 2.0 + scale * (values[:, 0] - middle[0])
        y = height / 2.0 - scale * (values[:, axis] - middle[axis])
        return np.column_stack([np.clip(x, 4.0, WIDTH - 4.0), np.clip(y, 4.0, height - 4.0)])

    inside = ((points >= low) & (points <= high)).all(axis=1)
    shown = points[inside]
    return Placed(
        paper(cameras, 1),
        paper(cameras, 2),
        (heights[0], heights[1]),
        paper(shown, 1),
        paper(shown, 2),
        ahead[:, [0, 1]] * [1.0, -1.0],
        ahead[:, [0, 2]] * [1.0, -1.0],
        outside,
    )


def _drawable(view: SceneView) -> SceneView:
    """Return the view without places that are finite and whose squares are not: cameras unknown, points left out."""
    known = (np.abs(view.points) <= _MAX_PLACE).all(axis=1)
    centre = view.centre.copy()
    centre[(np.abs(centre) > _MAX_PLACE).any(axis=1)] = np.nan
    return replace(view, points=view.points[known], centre=centre)


def principal_axes(view: SceneView) -> FloatArray:
    """Return (3, 3) rows: the longest horizontal axis, the other one, and up."""
    spread = _spread(view.points) + _spread(view.centre)
    _, _, axes = np.linalg.svd(spread)
    known = view.up[np.isfinite(view.up).all(axis=1)]
    mean_up = known.mean(axis=0) if len(known) else np.zeros(3)
    length = float(np.linalg.norm(mean_up))
    if length < _MIN_AGREEMENT:
        up = axes[2]
    else:
        mean_up = mean_up / length
        nearest = axes[int(np.argmax(np.abs(axes @ mean_up)))]
        along = float(nearest @ mean_up)
        up = np.copysign(1.0, along) * nearest if abs(along) >= _NEAR_UP else mean_up
    flat = np.eye(3) - np.outer(up, up)
    _, _, level = np.linalg.svd(flat @ spread @ flat + 1e-12 * flat)
    return np.stack([level[0], np.cross(up, level[0]), up])  # right-handed: no view is a mirror image


def _spread(cloud: FloatArray) -> FloatArray:
    """Return the second moments (3, 3) of a cloud without its farthest tenth; points and cameras count alike."""
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if len(cloud) < 2:
        return 1e-9 * np.eye(3)
    near = np.full(len(cloud), fill_value=True)
    for _ in range(3):  # a median by axis would turn with the frame of the world
        off = cloud - cloud[near].mean(axis=0)
        length = np.hypot(np.hypot(off[:, 0], off[:, 1]), off[:, 2])
        near = length <= np.quantile(length, 0.9)
    off, scale = off[near], float(length[near].max()) or 1.0
    return np.asarray((off / scale).T @ (off / scale) / len(off)) + 1e-9 * np.eye(3)


def top_view(placed: Placed, verdicts: Sequence[str | None], pairs: IntArray, label: str) -> Markup:
    """Draw the model from above; ``verdicts``: one per camera, None where the page does not hold it."""
    looks = _by_verdict(verdicts)
    body = [_points(placed.points_top), _links(placed.top, pairs), *_wedges(placed.top, placed.ahead_top, looks)]
    return picture("".join(body) + '<g class="picked"></g>', (WIDTH, placed.heights[0]), label)


def side_view(placed: Placed, verdicts: Sequence[str | None], label: str) -> Markup:
    """Draw the model from its side."""
    looks = _by_verdict(verdicts)
    body = [_points(placed.points_side), *_wedges(placed.side, placed.ahead_side, looks)]
    return picture("".join(body) + '<g class="picked"></g>', (WIDTH, placed.heights[1]), label)


def strongest_pairs(view: SceneView, per_image: int) -> IntArray:
    """Return (m, 2) pairs that are among the ``per_image`` strongest of one of their images."""
    if not len(view.pairs):
        return view.pairs
    both = np.concatenate([view.pairs, view.pairs[:, ::-1]])
    shared = np.concatenate([view.shared, view.shared])
    order = np.lexsort((-shared, both[:, 0]))
    image = both[order, 0]
    first = np.flatnonzero(np.concatenate([[True], image[1:] != image[:-1]]))
    rank = np.arange(len(image)) - np.repeat(first, np.diff(np.append(first, len(image))))
    kept = both[order][rank < per_image]
    return np.unique(np.sort(kept, axis=1), axis=0)


def _bounds(cameras: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Low and high ends of what is shown, (3,) each, and which cameras lie outside of it."""
    known = cameras[np.isfinite(cameras).all(axis=1)]
    known = known if len(known) else np.zeros((1, 3))
    low, high = np.quantile(known, [0.1, 0.9], axis=0)
    reach = float((high - low).max())
    near = known[((known >= low - _FAR_OUT * reach) & (known <= high + _FAR_OUT * reach)).all(axis=1)]
    low, high = np.minimum(low, near.min(axis=0, initial=np.inf)), np.maximum(high, near.max(axis=0, initial=-np.inf))
    with np.errstate(invalid="ignore"):
        outside = ~((cameras >= low) & (cameras <= high)).all(axis=1)
    if len(points):
        inner = np.quantile(points, [0.05, 0.95], axis=0)
        room = 2.0 * float((high - low).max()) or float((inner[1] - inner[0]).max())
        low, high = (
            np.minimum(low, np.maximum(inner[0], low - room)),
            np.maximum(high, np.minimum(inner[1], high + room)),
        )
    least = max(float((high - low).max()) * 1e-3, float(np.abs(high).max()) * 1e-12, 1e-100)
    thin = np.maximum(least - (high - low), 0.0) / 2.0
    return low - thin, high + thin, outside


def _by_verdict(verdicts: Sequence[str | None]) -> Mapping[str, BoolArray]:
    known = np.array([verdict or "other" for verdict in verdicts], dtype=object)
    order = ("other", Verdict.ACCEPTED, Verdict.UNDETERMINED, Verdict.REJECTED)  # what matters lies on top
    return {str(name): np.asarray(known == name, dtype=bool) for name in order}


def _points(at: FloatArray) -> str:
    return f'<path class="cloud" d="{"".join(f"M{x:.0f} {y:.0f}h0" for x, y in at.tolist())}"/>'


def _links(at: FloatArray, pairs: IntArray) -> str:
    both = np.column_stack([at[pairs[:, 0]], at[pairs[:, 1]]]) if len(pairs) else np.zeros((0, 4))
    ends = both[np.isfinite(both).all(axis=1)].tolist()
    return f'<path class="links" d="{"".join(f"M{a:.0f} {b:.0f}L{c:.0f} {d:.0f}" for a, b, c, d in ends)}"/>'


def _wedges(at: FloatArray, ahead: FloatArray, looks: Mapping[str, BoolArray]) -> list[str]:
    """Cameras as wedges that open where they look; verdicts differ in filling as well as in colour."""
    size = float(np.clip(150.0 / max(len(at), 1) ** 0.5, 5.0, 13.0))
    ahead = np.where(np.isfinite(ahead), ahead, 0.0)
    length = np.hypot(*ahead.T)[:, None]
    across = np.divide(np.column_stack([-ahead[:, 1], ahead[:, 0]]), length, out=np.zeros_like(ahead), where=length > 0)
    across = np.where(length > 0, across, [1.0, 0.0])
    base = at + size * np.where(length > 0.25, ahead, ahead + np.array([0.0, 0.25]))
    left, right = base - 0.45 * size * across, base + 0.45 * size * across
    out = []
    for name, chosen in looks.items():
        table = np.column_stack([at, left, right])[chosen]
        table = table[np.isfinite(table).all(axis=1)].tolist()
        d = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {e:.1f} {f:.1f} {g:.1f}Z" for a, b, c, e, f, g in table)
        out.append(f'<path class="wedge {escape(name)}" d="{d}"/>' if d else "")
    return out
