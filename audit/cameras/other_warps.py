r"""How do lenses move a point that COLMAP has no model for? One function per distortion, as in `warps`.

- brown           OpenSfM ``DistoBrown`` (src/geometry/camera_distortions_functions.h), OpenMVG
                  ``Pinhole_Intrinsic_Brown_T2``: FULL_OPENCV without a denominator
- frame           Metashape's frame camera (manual, "Camera models"): four radial terms, affinity and skew
- dual            OpenSfM ``DualProjection``: t (X, Y) / Z + (1 - t) theta (X, Y) / rho, then two radial terms
- inverse_radial  VisualSFM, PBA ``MeasurementDistortion``: the undistorted point is d (1 + k d^2)

Checked against FULL_OPENCV, RADIAL and RADIAL_FISHEYE of pycolmap where these hold them, and against the formulas of
their programs, written again in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.columns import Want, Warp
from sfm_audit.audit.cameras.fisheye import angle_curvature, angle_gain
from sfm_audit.audit.cameras.inverse import unit_rays
from sfm_audit.audit.cameras.warps import Pair, radial, radial_gain, radial_tangential, tangential_extra
from sfm_audit.loaders.arrays import FloatArray

_NEWTON_STEPS: Final = 60


def brown(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """BROWN, SIMPLE_BROWN: three radial terms, two tangential ones; extra = k1 k2 p1 p2 k3."""
    k1, k2, p1, p2, k3 = extra
    warp, radials, tangentials = _brown(u, v, (k1, k2, k3), (p1, p2), want)
    return warp._replace(d_extra=(*radials[:2], *tangentials, radials[2])) if want is Want.D_EXTRA else warp


def _brown(
    u: FloatArray, v: FloatArray, k: Sequence[float], p: tuple[float, float], want: Want
) -> tuple[Warp, tuple[Pair, ...], tuple[Pair, ...]]:
    """Return the warp and, where wanted, its derivatives by the radial and by the tangential coefficients."""
    r2 = u * u + v * v
    gain, slope = radial_gain(r2, k)
    warp = radial_tangential(u, v, r2, gain, slope, p1=p[0], p2=p[1], want=want)
    if want is not Want.D_EXTRA:
        return warp, (), ()
    powers = [r2]
    for _ in k[1:]:
        powers.append(powers[-1] * r2)
    return warp, tuple((u * power, v * power) for power in powers), tangential_extra(u, v, r2)


def frame(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """FRAME: Brown's lens with k4, then x becomes (1 + b1) x + b2 y; extra = k1 k2 p1 p2 k3 k4 b1 b2."""
    k1, k2, p1, p2, k3, k4, b1, b2 = extra
    lens, radials, tangentials = _brown(u, v, (k1, k2, k3, k4), (p1, p2), want)
    stretch = 1.0 + b1
    x = stretch * lens.x + b2 * lens.y
    if want is Want.VALUE:
        return Warp(x, lens.y)
    xu, xv = stretch * lens.xu + b2 * lens.yu, stretch * lens.xv + b2 * lens.yv
    warp = Warp(x, lens.y, xu, xv, lens.yu, lens.yv)
    if want is not Want.D_EXTRA:
        return warp
    inner = (*radials[:2], *tangentials, *radials[2:])
    moved = tuple((stretch * d_x + b2 * d_y, d_y) for d_x, d_y in inner)
    return warp._replace(d_extra=(*moved, (lens.x, 0.0), (lens.y, 0.0)))


def dual(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """DUAL: a mean of the perspective and the equidistant point, then two radial terms; extra = k1 k2 transition.

    With g = t + (1 - t) theta / tan(theta) the mean is (u, v) g; D is the derivative of the radial terms there.
    """
    k1, k2, transition = extra
    tan2 = u * u + v * v
    angle = angle_gain(tan2)
    gain = transition + (1.0 - transition) * angle
    lens = radial(u * gain, v * gain, (k1, k2), want)
    if want is Want.VALUE:
        return lens
    bend = (1.0 - transition) * angle_curvature(tan2, angle)
    au, av, bv = gain + bend * u * u, bend * u * v, gain + bend * v * v
    xu, xv = lens.xu * au + lens.xv * av, lens.xu * av + lens.xv * bv
    yu, yv = lens.yu * au + lens.yv * av, lens.yu * av + lens.yv * bv
    warp = Warp(lens.x, lens.y, xu, xv, yu, yv)
    if want is not Want.D_EXTRA:
        return warp
    du, dv = u * (1.0 - angle), v * (1.0 - angle)
    return warp._replace(d_extra=(*lens.d_extra, (lens.xu * du + lens.xv * dv, lens.yu * du + lens.yv * dv)))


def inverse_radial(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
    """INVERSE_RADIAL: (u, v) g where g (1 + k g^2 r^2) = 1; extra = k.

    g is the root that is 1 on the axis; NaN beyond the fold of the polynomial, 27 k r^2 < -4.
    """
    (k,) = extra
    r2 = u * u + v * v
    gain = _inverse_gain(k * r2)
    if want is Want.VALUE:
        return Warp(u * gain, v * gain)
    cube = gain * gain * gain
    fall = -cube / (1.0 + 3.0 * k * r2 * gain * gain)  # d gain / d (k r^2)
    hu, hv = (2.0 * k) * fall * u, (2.0 * k) * fall * v
    cross = hu * v
    warp = Warp(u * gain, v * gain, gain + hu * u, cross, cross, gain + hv * v)
    if want is not Want.D_EXTRA:
        return warp
    return warp._replace(d_extra=((u * r2 * fall, v * r2 * fall),))


def inverse_radial_rays(x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return (n, 3) unit rays of distorted points of INVERSE_RADIAL; NaN from the fold on, 3 k r_d^2 <= -1."""
    (k,) = extra
    r2 = x * x + y * y
    gain = np.where(3.0 * k * r2 > -1.0, 1.0 + k * r2, np.nan)
    return unit_rays(x * gain, y * gain, np.ones_like(x))


def _inverse_gain(a: FloatArray) -> FloatArray:
    """Return the root g of a g^3 + g = 1 that is 1 at a = 0; NaN below a = -4 / 27, where there is none.

    Newton's method from the side on which it does not overshoot: from 1 for a > 0, where the cubic is convex above its
    root, and for a < 0 from 1 as well, where the cubic is concave and below 0.
    """
    gain = np.where(a >= -4.0 / 27.0, 1.0, np.nan)
    moving = np.ones(a.shape, dtype=np.bool_)
    for _ in range(_NEWTON_STEPS):
        step = (a * gain * gain * gain + gain - 1.0) / (3.0 * a * gain * gain + 1.0)
        gain = np.where(moving, gain - step, gain)
        moving &= np.abs(step) > 1e-15 * gain
        if not moving.any():
            break
    return gain
