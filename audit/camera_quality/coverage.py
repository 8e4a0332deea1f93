"""How much of the image do the inliers see? (method.md section 6)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

_Point: TypeAlias = tuple[float, float]
_FEW: Final = 12  # points that are not worth thinning out before the hull
_DIRECTIONS: Final = np.array([[0, 1, 1, 2, 1, 2, 1, 1], [1, 2, 1, 1, 0, -1, -1, -2]], dtype=np.float64).T
_FLAT: Final = 1e-13  # of the squared size: what is smaller is rounding of points on one line
_MAX_CELLS: Final = 1 << 22  # in memory at the same time


class Spread(NamedTuple):
    """How far the inliers of B images spread: coverage (B,), occupied_cells (B,)."""

    coverage: FloatArray
    occupied_cells: IntArray


def spread_of(xy_px: FloatArray, offsets: IntArray, cameras: Sequence[CameraRecord], grid: int) -> Spread:
    """Return `coverage` and `occupied_cells` of B images.

    Parameters
    ----------
    xy_px : (n, 2) observed, image after image; image b owns rows offsets[b]:offsets[b + 1]        offsets : (B + 1,)
    """
    size_px = sizes_of(cameras)
    hulls = np.array([hull_area_px2(xy_px[first:last]) for first, last in pairwise(offsets.tolist())], dtype=np.float64)
    return Spread(covered(hulls, size_px), cells_of(xy_px, offsets, size_px, grid))


def sizes_of(cameras: Sequence[CameraRecord]) -> FloatArray:
    """Return (B, 2) width and height, px."""
    return np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64).reshape(-1, 2)


def covered(hull_px2: FloatArray, size_px: FloatArray) -> FloatArray:
    """Return `coverage` of B images from the areas of their hulls (B,) and their sizes (B, 2)."""
    area = size_px[:, 0] * size_px[:, 1]
    with np.errstate(all="ignore"):
        return np.where(area > 0.0, hull_px2 / area, np.nan)


def hull_area_px2(xy_px: FloatArray) -> float:
    """Area, px^2, of the convex hull of (n, 2) image points; 0 when they are fewer than three or on one line.

    Notes
    -----
    Andrew's monotone chain over what lies outside of a box and of the polygon of the extreme points in 16 directions;
    the area is that of the triangles from the leftmost point.
    """
    outer = xy_px
    for thinned in (_outside_box, _outside_polygon):
        outer = thinned(outer) if len(outer) > _FEW else outer
    points = sorted(map(tuple, outer.tolist()))
    if len(points) < 3:
        return 0.0
    left, right = points[0], points[-1]
    twice = _fan(left, _chain(points)) + _fan(left, _chain(points[::-1]))
    tall = max(y for _, y in points) - min(y for _, y in points)
    wide = right[0] - left[0]
    return 0.5 * twice if twice > _FLAT * (wide * wide + tall * tall) else 0.0


def _chain(points: list[_Point]) -> list[_Point]:
    """Return the hull from the first to the last of sorted points, which turns left everywhere."""
    out: list[_Point] = []
    for point in points:
        x, y = point
        while len(out) > 1:
            (ax, ay), (bx, by) = out[-2], out[-1]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                break
            out.pop()
        out.append(point)
    return out


def _fan(centre: _Point, chain: list[_Point]) -> float:
    """Twice the area of the triangles from a point to the edges of a chain."""
    twice = 0.0
    x, y = centre
    for (ax, ay), (bx, by) in pairwise(chain):  # Python's sum rounds as its version likes
        twice += (ax - x) * (by - y) - (ay - y) * (bx - x)
    return twice


def _outside_box(xy_px: FloatArray) -> FloatArray:
    """Drop points strictly inside a box between the extreme points along the diagonals: nine of ten, at little cost.

    Whichever corner of the box, both edges of the quadrilateral of those points that meet beyond it are outside of it.
    """
    x, y = np.ascontiguousarray(xy_px.T)
    along, across = x + y, x - y
    most, least, right, left = along.argmax(), along.argmin(), across.argmax(), across.argmin()
    inside = (x > max(x[least], x[left])) & (x < min(x[most], x[right]))
    inside &= (y > max(y[least], y[right])) & (y < min(y[most], y[left]))
    return xy_px.compress(~inside, axis=0)


def _outside_polygon(xy_px: FloatArray) -> FloatArray:
    """Drop points strictly inside the polygon of the extreme points in some directions: they are not on the hull."""
    along = _DIRECTIONS @ xy_px.T
    corners = np.unique(np.concatenate([along.argmin(axis=1), along.argmax(axis=1)]))
    polygon = _counter_clockwise(xy_px[corners])
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([-edges[:, 1], edges[:, 0]])
    inside = (normals @ xy_px.T > (normals * polygon).sum(axis=1)[:, None]).all(axis=0)
    inside[corners] = False  # whatever rounding says
    return xy_px.compress(~inside, axis=0)


def _counter_clockwise(corners: FloatArray) -> FloatArray:
    """Order the vertices of a convex polygon around their mean."""
    offset = corners - corners.mean(axis=0)
    return corners[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))]


def coverage(xy_px: FloatArray, width: int, height: int) -> float:
    """Hull of the observed inliers / image area; not clipped, so points outside the image count; NaN without area."""
    return hull_area_px2(xy_px) / (width * height) if width * height > 0 else float("nan")


def occupied_cells(xy_px: FloatArray, width: int, height: int, grid: int) -> int:
    """Number of cells with at least one inlier, of a grid x grid division of the image; outside points are in none."""
    return int(cells_of(xy_px, np.array([0, len(xy_px)]), np.array([[width, height]], dtype=np.float64), grid)[0])


def cells_of(xy_px: FloatArray, offsets: IntArray, size_px: FloatArray, grid: int) -> IntArray:
    """Return `occupied_cells` of B images: points (n, 2), image after image, with offsets (B + 1,), sizes (B, 2)."""
    out = np.zeros(len(size_px), dtype=np.int64)
    step = max(1, _MAX_CELLS // (grid * grid))
    for start in range(0, len(out), step):
        own, sizes = offsets[start : start + step + 1], size_px[start : start + step]
        xy = xy_px[own[0] : own[-1]].T
        image = np.repeat(np.arange(len(sizes)), np.diff(own))
        with np.errstate(all="ignore"):
            per_px = np.where(np.all(sizes > 0, axis=1, keepdims=True), grid / sizes, np.nan).T
            column, row = (np.floor(along * own_per_px[image]) for along, own_per_px in zip(xy, per_px, strict=True))
        inside = np.flatnonzero((column >= 0) & (column < grid) & (row >= 0) & (row < grid))
        place = (image[inside] * grid + column[inside].astype(np.int64)) * grid + row[inside].astype(np.int64)
        hit = np.zeros(len(sizes) * grid * grid, dtype=np.bool_)
        hit[place] = True
        out[start : start + step] = np.count_nonzero(hit.reshape(len(sizes), -1), axis=1)
    return out
