"""From the distorted normalised plane back to rays: in closed form where there is one, else by Newton's method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, cast

import numpy as np

from sfm_audit.audit.cameras.columns import EPSILON, Want
from sfm_audit.audit.cameras.warps import WarpFunction, radial, radial_gain
from sfm_audit.loaders.arrays import BoolArray, FloatArray

MAX_ITERATIONS: Final = 100
STEP: Final = 0.25
"""Longest step: this share of the current radius, or this much where the radius is below 1."""
CONVERGED: Final = 1e-9
"""Relative step after which Newton's next one is below rounding."""
TOLERANCE: Final = 1e-11
"""Largest relative error of the distorted point that counts as a solution."""
FRACTIONS: Final = np.arange(1, 17) / 16.0
"""Where on the way from the axis to a solution the distortion must not be folded."""


def perspective_rays(warp: WarpFunction, x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return (n, 3) unit rays of distorted points (n,) each on the plane Z = 1; NaN where none was found."""
    u, v = undistort(warp, extra, x, y)
    return unit_rays(u, v, np.ones_like(u))


def fisheye_rays(warp: WarpFunction, x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return (n, 3) unit rays of distorted points (n,) each on the equidistant plane; NaN where theta >= 90 degrees."""
    u, v = undistort(warp, extra, x, y)
    theta = np.hypot(u, v)
    depth = np.cos(theta)
    depth[(theta >= np.pi / 2.0) | (depth < EPSILON)] = np.nan
    gain = np.sinc(theta / np.pi)
    return unit_rays(u * gain, v * gain, depth)


def unit_rays(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Return (n, 3) unit vectors, all NaN where one component is not finite."""
    rays = np.column_stack([x, y, z])
    length = np.sqrt((rays * rays).sum(axis=1))
    return rays / np.where(np.isfinite(length), length, np.nan)[:, None]


def undistort(
    warp: WarpFunction, extra: Sequence[float], x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the (n,) undistorted u, v with warp(u, v) = (x, y); NaN where there is none or it was not found."""
    if not extra:
        return x.copy(), y.copy()
    if warp is radial:
        return _undistort_radially(extra, x, y)
    u, v = np.zeros_like(x), np.zeros_like(y)
    moving = np.ones(x.shape, dtype=np.bool_)  # each point stops by itself: others do not matter to it
    for _ in range(MAX_ITERATIONS):
        at = warp(u, v, extra, Want.D_POINT)
        determinant = at.xu * at.yv - at.xv * at.yu
        dx, dy = (at.x - x) / determinant, (at.y - y) / determinant
        du, dv = at.yv * dx - at.xv * dy, at.xu * dy - at.yu * dx
        radius, length = np.hypot(u, v), np.hypot(du, dv)
        reach = STEP * np.maximum(radius, 1.0)
        shorten = reach / np.maximum(reach, length)
        u, v = np.where(moving, u - shorten * du, u), np.where(moving, v - shorten * dv, v)
        moving &= length > CONVERGED * (1.0 + radius)
        if not moving.any():
            break
    at = warp(u, v, extra, Want.VALUE)
    found = np.hypot(at.x - x, at.y - y) <= TOLERANCE * (1.0 + np.hypot(x, y))
    found &= ~_folded_on_the_way(warp, extra, u, v)
    return np.where(found, u, np.nan), np.where(found, v, np.nan)


def _undistort_radially(extra: Sequence[float], x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Do what `undistort` does for the warp ``radial``, whose steps all point along the radius."""
    goal = np.hypot(x, y)
    radius = np.zeros_like(goal)
    moving = np.ones(goal.shape, dtype=np.bool_)
    for _ in range(MAX_ITERATIONS):
        r2 = radius * radius
        gain, slope = radial_gain(r2, extra)
        step = (radius * gain - goal) / (gain + (2.0 * slope) * r2)
        size, length = np.abs(radius), np.abs(step)
        reach = STEP * np.maximum(size, 1.0)
        radius = np.where(moving, radius - step * (reach / np.maximum(reach, length)), radius)
        moving &= length > CONVERGED * (1.0 + size)
        if not moving.any():
            break
    gain, _ = radial_gain(radius * radius, extra)
    found = np.abs(radius * gain - goal) <= TOLERANCE * (1.0 + goal)
    r2_on_the_way = np.multiply.outer(FRACTIONS**2, radius * radius)
    gain_on_the_way, slope = radial_gain(r2_on_the_way, extra)
    determinant = gain_on_the_way * (gain_on_the_way + (2.0 * slope) * r2_on_the_way)
    found &= determinant.min(axis=0) > 0.0
    return np.where(found, x / gain, np.nan), np.where(found, y / gain, np.nan)


def _folded_on_the_way(warp: WarpFunction, extra: Sequence[float], u: FloatArray, v: FloatArray) -> BoolArray:
    """Whether the distortion turns over somewhere on the segment from the axis to (u, v), (n,)."""
    on_the_way = np.multiply.outer(FRACTIONS, np.stack([u, v]))
    own = [np.tile(each, len(FRACTIONS)) if np.ndim(each) else each for each in extra]
    at = warp(on_the_way[:, 0].ravel(), on_the_way[:, 1].ravel(), cast("Sequence[float]", own), Want.D_POINT)
    determinant = np.asarray(at.xu * at.yv - at.xv * at.yu, dtype=np.float64)
    smallest: FloatArray = determinant.reshape(len(FRACTIONS), -1).min(axis=0)
    return ~(smallest > 0.0)
