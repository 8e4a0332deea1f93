r"""How does a lens move a point of the normalised plane? One function per distortion, with analytic derivatives.

Every function takes the undistorted point ``u``, ``v`` ((n,) each; (X, Y) / Z, or theta (X, Y) / rho for fisheye
models), the extra parameters in COLMAP's order and what to compute. With r^2 = u^2 + v^2:

- radial        (u, v) g(r^2), hence dx/du = g + u^2 h, dx/dv = dy/du = u v h, dy/dv = g + v^2 h with h = 2 dg/dr^2
- tangential    2 p1 u v + p2 (r^2 + 2 u^2)  and  2 p2 u v + p1 (r^2 + 2 v^2)
- thin prism    polynomials in r^2, another one on each axis

Formulas: COLMAP 4.2, src/colmap/sensor/models.h; checked against pycolmap in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np

from sfm_audit.audit.cameras.columns import Column, Want, Warp
from sfm_audit.loaders.arrays import FloatArray

Pair: TypeAlias = tuple[Column, Column]
WarpFunction: TypeAlias = Callable[[FloatArray, FloatArray, Sequence[float], Want], Warp]

FOV_SMALL: Final = 1e-4
"""COLMAP's threshold on omega^2 and on r^2, below which FOV is a Taylor polynomial."""


def identity(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """Leave the point where it is: SIMPLE_PINHOLE, PINHOLE, SIMPLE_FISHEYE, FISHEYE."""
    del extra, want
    return Warp(u, v, 1.0, 0.0, 0.0, 1.0)


def _polynomial(r2: FloatArray, coefficients: Sequence[float]) -> tuple[FloatArray, Column]:
    """Return p = sum_i c_i r2^i (i = 1, 2, ..) and dp / dr2, by Horner's rule."""
    highest = coefficients[-1]
    if len(coefficients) == 1:
        return highest * r2, highest
    value = highest * r2 + coefficients[-2]
    slope: Column = highest
    for coefficient in coefficients[-3::-1]:
        slope = slope * r2 + value
        value = value * r2 + coefficient
    return value * r2, slope * r2 + value


def _radial_extra(u: FloatArray, v: FloatArray, r2: FloatArray, count: int) -> tuple[Pair, ...]:
    """Return the columns (u, v) r^2i, i = 1 .. count: the derivatives by the coefficients of a radial polynomial."""
    columns = [(u * r2, v * r2)]
    for _ in range(count - 1):
        columns.append((columns[-1][0] * r2, columns[-1][1] * r2))
    return tuple(columns)


def _radially(u: FloatArray, v: FloatArray, gain: FloatArray, slope: Column, d_extra: tuple[Pair, ...]) -> Warp:
    """Return the warp (u, v) gain, where ``slope`` = d gain / d r^2."""
    hu = (2.0 * slope) * u
    hv = (2.0 * slope) * v
    cross = hu * v
    return Warp(u * gain, v * gain, gain + hu * u, cross, cross, gain + hv * v, d_extra)


def radial(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """Scale by 1 + k1 r^2 + k2 r^4 + ..: SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE and the radial fisheye models."""
    r2 = u * u + v * v
    gain, slope = radial_gain(r2, extra)
    if want is Want.VALUE:
        return Warp(u * gain, v * gain)
    return _radially(u, v, gain, slope, _radial_extra(u, v, r2, len(extra)) if want is Want.D_EXTRA else ())


def radial_gain(r2: FloatArray, extra: Sequence[float]) -> tuple[FloatArray, Column]:
    """Return g = 1 + k1 r^2 + k2 r^4 + .. and dg / d r^2, by which ``radial`` scales."""
    gain, slope = _polynomial(r2, extra)
    gain += 1.0
    return gain, slope


def tangential_extra(u: FloatArray, v: FloatArray, r2: FloatArray) -> tuple[Pair, Pair]:
    """Return the derivatives by p1 and p2."""
    double_cross = 2.0 * u * v
    return (double_cross, r2 + 2.0 * v * v), (r2 + 2.0 * u * u, double_cross)


def radial_tangential(
    u: FloatArray, v: FloatArray, r2: FloatArray, gain: FloatArray, slope: Column, *, p1: float, p2: float, want: Want
) -> Warp:
    """Return (u, v) gain plus the tangential terms, without derivatives by extra parameters."""
    common = gain + 2.0 * (p1 * v + p2 * u)
    x = u * common + p2 * r2
    y = v * common + p1 * r2
    if want is Want.VALUE:
        return Warp(x, y)
    hu = (2.0 * slope) * u
    hv = (2.0 * slope) * v
    cross = hu * v + 2.0 * (p1 * u + p2 * v)
    return Warp(x, y, common + u * (hu + 4.0 * p2), cross, cross, common + v * (hv + 4.0 * p1))


def opencv(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """OPENCV: two radial terms, two tangential ones; extra = k1 k2 p1 p2."""
    k1, k2, p1, p2 = extra
    r2 = u * u + v * v
    gain, slope = _polynomial(r2, (k1, k2))
    gain += 1.0
    warp = radial_tangential(u, v, r2, gain, slope, p1=p1, p2=p2, want=want)
    if want is not Want.D_EXTRA:
        return warp
    return warp._replace(d_extra=(*_radial_extra(u, v, r2, 2), *tangential_extra(u, v, r2)))


def full_opencv(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """FULL_OPENCV: a ratio of two radial polynomials, and tangential terms; extra = k1 k2 p1 p2 k3 k4 k5 k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = extra
    r2 = u * u + v * v
    upper, d_upper = _polynomial(r2, (k1, k2, k3))
    lower, d_lower = _polynomial(r2, (k4, k5, k6))
    inverse = 1.0 / (1.0 + lower)
    gain = (1.0 + upper) * inverse
    warp = radial_tangential(u, v, r2, gain, (d_upper - gain * d_lower) * inverse, p1=p1, p2=p2, want=want)
    if want is not Want.D_EXTRA:
        return warp
    above = _radial_extra(u * inverse, v * inverse, r2, 3)
    below = tuple((-gain * x, -gain * y) for x, y in above)
    return warp._replace(d_extra=(*above[:2], *tangential_extra(u, v, r2), above[2], *below))


def thin_prism(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """THIN_PRISM_FISHEYE; extra = k1 k2 p1 p2 k3 k4 sx1 sy1."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = extra
    r2 = u * u + v * v
    gain, slope = _polynomial(r2, (k1, k2, k3, k4))
    gain += 1.0
    warp = radial_tangential(u, v, r2, gain, slope, p1=p1, p2=p2, want=want)
    x, y = warp.x + sx1 * r2, warp.y + sy1 * r2
    if want is Want.VALUE:
        return Warp(x, y)
    d_extra: tuple[Pair, ...] = ()
    if want is Want.D_EXTRA:
        powers = _radial_extra(u, v, r2, 4)
        d_extra = (*powers[:2], *tangential_extra(u, v, r2), *powers[2:], (r2, 0.0), (0.0, r2))
    xu, xv = warp.xu + (2.0 * sx1) * u, warp.xv + (2.0 * sx1) * v
    yu, yv = warp.yu + (2.0 * sy1) * u, warp.yv + (2.0 * sy1) * v
    return Warp(x, y, xu, xv, yu, yv, d_extra)


def rad_tan_thin_prism(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """RAD_TAN_THIN_PRISM_FISHEYE: tangential and prism terms act on the radially distorted point (a, b).

    extra = k0 .. k5 p0 p1 s0 s1 s2 s3; p0 is OPENCV's p2, p1 is p1.
    """
    p0, p1, s0, s1, s2, s3 = extra[6:]
    first = radial(u, v, extra[:6], want)
    a, b = first.x, first.y
    r2 = a * a + b * b
    second = radial_tangential(a, b, r2, np.ones_like(a), 0.0, p1=p1, p2=p0, want=want)
    x, y = second.x + r2 * (s0 + s1 * r2), second.y + r2 * (s2 + s3 * r2)
    if want is Want.VALUE:
        return Warp(x, y)
    prism_x, prism_y = 2.0 * s0 + (4.0 * s1) * r2, 2.0 * s2 + (4.0 * s3) * r2
    xa, xb, ya, yb = second.xu + prism_x * a, second.xv + prism_x * b, second.yu + prism_y * a, second.yv + prism_y * b
    d_extra: tuple[Pair, ...] = ()
    if want is Want.D_EXTRA:
        d_p1, d_p0 = tangential_extra(a, b, r2)
        r4 = r2 * r2
        d_radial = tuple((xa * da + xb * db, ya * da + yb * db) for da, db in first.d_extra)
        d_extra = (*d_radial, d_p0, d_p1, (r2, 0.0), (r4, 0.0), (0.0, r2), (0.0, r4))
    xu, xv = xa * first.xu + xb * first.yu, xa * first.xv + xb * first.yv
    yu, yv = ya * first.xu + yb * first.yu, ya * first.xv + yb * first.yv
    return Warp(x, y, xu, xv, yu, yv, d_extra)


def fov(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    r"""FOV: scale by arctan(2 r tan(omega / 2)) / (r omega); extra = omega, radians.

    Notes
    -----
    Piecewise, like COLMAP: for omega^2 < 1e-4 the gain is 1 + omega^2 (r^2 / 3 - 1 / 12), for r^2 < 1e-4 it is
    2 t / omega (1 - 4 r^2 t^2 / 3) with t = tan(omega / 2). The first of these is the expansion of the *inverse* map;
    that of the map itself has the opposite sign. It is kept because it is what COLMAP measured its residuals with;
    the two gains differ by omega^2 (2 r^2 / 3 - 1 / 6), below 1e-4 inside r = 1.
    """
    (omega,) = extra
    r2 = u * u + v * v
    if omega * omega < FOV_SMALL:
        gain, slope, d_omega = _fov_small_omega(r2, omega)
    else:
        gain, slope, d_omega = _fov_general(r2, omega)
    if want is Want.VALUE:
        return Warp(u * gain, v * gain)
    return _radially(u, v, gain, slope, ((u * d_omega, v * d_omega),) if want is Want.D_EXTRA else ())


def _fov_small_omega(r2: FloatArray, omega: float) -> tuple[FloatArray, Column, FloatArray]:
    """Return gain, d gain / d r^2, d gain / d omega for omega^2 < 1e-4."""
    shape = r2 / 3.0 - 1.0 / 12.0
    return 1.0 + omega * omega * shape, omega * omega / 3.0, 2.0 * omega * shape


def _fov_general(r2: FloatArray, omega: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return gain, d gain / d r^2, d gain / d omega for omega^2 >= 1e-4."""
    tangent = math.tan(omega / 2.0)
    d_tangent = (1.0 + tangent * tangent) / 2.0
    safe_r2 = np.maximum(r2, FOV_SMALL)
    radius = np.sqrt(safe_r2)
    inverse = 1.0 / (omega * (1.0 + (4.0 * tangent * tangent) * safe_r2))
    gain = np.arctan(2.0 * tangent * radius) / (radius * omega)
    slope = (2.0 * tangent * inverse - gain) / (2.0 * safe_r2)
    d_omega = 2.0 * d_tangent * inverse - gain / omega
    near = np.flatnonzero(r2 < FOV_SMALL)
    if len(near):
        curvature = -8.0 * tangent**3 / (3.0 * omega)
        gain[near] = 2.0 * tangent / omega + curvature * r2[near]
        slope[near] = curvature
        d_curvature = -8.0 * tangent**2 * d_tangent / omega - curvature / omega
        d_omega[near] = 2.0 * (d_tangent - tangent / omega) / omega + d_curvature * r2[near]
    return gain, slope, d_omega
