"""Models that are linear in the angle theta to the optical axis, up to a distortion of that equidistant plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.columns import Plane, Want, in_front
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.loaders.arrays import FloatArray

NEAR_AXIS: Final = 1e-3
"""tan(theta)^2 below which the curvature of theta / tan(theta) comes from its series (cancellation otherwise)."""


def angle_gain(tan2: FloatArray) -> FloatArray:
    """Return theta / tan(theta) for tan(theta)^2, 1 on the axis."""
    tangent = np.sqrt(np.maximum(tan2, np.finfo(np.float64).tiny))
    return np.arctan(tangent) / tangent


def angle_curvature(tan2: FloatArray, gain: FloatArray) -> FloatArray:
    """Return 2 d gain / d tan2 = (1 / (1 + tan2) - gain) / tan2; -2/3 on the axis."""
    near = np.flatnonzero(tan2 < NEAR_AXIS)
    curvature = (1.0 / (1.0 + tan2) - gain) / np.maximum(tan2, NEAR_AXIS)
    if len(near):
        t = tan2[near]
        curvature[near] = -2.0 / 3.0 + t * (4.0 / 5.0 + t * (-6.0 / 7.0 + t * (8.0 / 9.0 - t * (10.0 / 11.0))))
    return curvature


def fisheye_plane(
    x_cam: FloatArray, y_cam: FloatArray, z_cam: FloatArray, warp: WarpFunction, extra: Sequence[float], *, want: Want
) -> Plane:
    """Distort theta (X, Y) / rho; NaN where Z is below COLMAP's epsilon, although such a lens could see there.

    With p = (X, Y) / Z, g = theta / tan(theta), b = 2 dg / d|p|^2 and w = D p (D the derivative of the distortion):
    d/dX = (g D_u + b p_x w) / Z, d/dY = (g D_v + b p_y w) / Z, d/dZ = -w / (1 + |p|^2) / Z.
    """
    inverse = 1.0 / in_front(z_cam)
    px, py = x_cam * inverse, y_cam * inverse
    tan2 = px * px + py * py
    gain = angle_gain(tan2)
    x, y, xu, xv, yu, yv, d_extra = warp(px * gain, py * gain, extra, want)
    if want is Want.VALUE:
        return Plane(x, y)
    bend = angle_curvature(tan2, gain) * inverse
    gain = gain * inverse
    fall = -inverse / (1.0 + tan2)
    wx, wy = xu * px + xv * py, yu * px + yv * py
    bend_x, bend_y = bend * wx, bend * wy
    d_x = (xu * gain + px * bend_x, xv * gain + py * bend_x, wx * fall)
    d_y = (yu * gain + px * bend_y, yv * gain + py * bend_y, wy * fall)
    return Plane(x, y, d_x + d_y, d_extra)
