"""How much of the image do the inliers see? (method.md section 6)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sfm_audit.loaders.arrays import FloatArray

_FEW = 12  # points that are not worth thinning out before the hull


def hull_area_px2(xy_px: FloatArray) -> float:
    """Area, px^2, of the convex hull of (n, 2) image points; 0 when they are fewer than three or on one line."""
    outer = _outside_octagon(xy_px) if len(xy_px) > _FEW else xy_px
    if len(outer) < 3:
        return 0.0
    try:
        return float(ConvexHull(outer).volume)  # in the plane Qhull's "volume" is the area
    except QhullError:  # collinear, to Qhull's precision
        return 0.0


def _outside_octagon(xy_px: FloatArray) -> FloatArray:
    """Drop points strictly inside the octagon of the extreme points in eight directions: they are not on the hull."""
    x, y = xy_px[:, 0], xy_px[:, 1]
    directions = (y, x + y, x, x - y)
    corners = {int(np.argmin(d)) for d in directions} | {int(np.argmax(d)) for d in directions}
    polygon = _counter_clockwise(xy_px[sorted(corners)])
    inside = np.ones(len(xy_px), dtype=bool)
    for (start_x, start_y), (end_x, end_y) in pairwise([*polygon.tolist(), polygon[0].tolist()]):
        along_x, along_y = end_x - start_x, end_y - start_y
        inside &= along_x * y - along_y * x > along_x * start_y - along_y * start_x
    return xy_px[~inside]


def _counter_clockwise(corners: FloatArray) -> FloatArray:
    """Order the vertices of a convex polygon around their mean."""
    offset = corners - corners.mean(axis=0)
    return corners[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))]


def coverage(xy_px: FloatArray, width: int, height: int) -> float:
    """Hull of the observed inliers / image area; not clipped, so points outside the image count; NaN without area."""
    return hull_area_px2(xy_px) / (width * height) if width * height > 0 else float("nan")


def occupied_cells(xy_px: FloatArray, width: int, height: int, grid: int) -> int:
    """Number of cells with at least one inlier, of a grid x grid division of the image; outside points are in none."""
    if width * height == 0 or not len(xy_px):
        return 0
    column, row = np.floor(xy_px[:, 0] * (grid / width)), np.floor(xy_px[:, 1] * (grid / height))
    inside = (column >= 0) & (column < grid) & (row >= 0) & (row < grid)
    index = (column * grid + row)[inside].astype(np.int64)
    return int(np.count_nonzero(np.bincount(index, minlength=grid * grid)))
