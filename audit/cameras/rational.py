r"""Models whose depth is replaced by another one: (X, Y) / m(X, Y, Z), in closed form both ways (division, EUCM).

With m_X, m_Y, m_Z the derivatives of m:  d(X/m)/dX = 1/m - X m_X / m^2,  d(X/m)/dY = -X m_Y / m^2, and so on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from sfm_audit.audit.cameras.columns import EPSILON, Plane, Want, in_front
from sfm_audit.loaders.arrays import FloatArray

PlaneFunction: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray, Sequence[float], Want], Plane]
Columns3: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


def _plane(
    x: FloatArray, y: FloatArray, inverse: FloatArray, d_m: Columns3, d_m_extra: tuple[FloatArray, ...]
) -> Plane:
    """Return (x, y) inverse, where ``d_m`` and ``d_m_extra`` are the derivatives of m = 1 / inverse."""
    px, py = x * inverse, y * inverse
    gx, gy = -px * inverse, -py * inverse
    m_x, m_y, m_z = d_m
    d_cam = (inverse + gx * m_x, gx * m_y, gx * m_z, gy * m_x, inverse + gy * m_y, gy * m_z)
    return Plane(px, py, d_cam, tuple((gx * m_p, gy * m_p) for m_p in d_m_extra))


def division_plane(x: FloatArray, y: FloatArray, z: FloatArray, extra: Sequence[float], want: Want) -> Plane:
    """SIMPLE_DIVISION, DIVISION: m = (Z + sqrt(Z^2 - 4 k rho^2)) / 2; extra = k.

    Not limited to Z > 0, like COLMAP: with k < 0 it sees points behind the camera. NaN where the root is not real,
    or m is 0. On the rim, where the root is 0, the projection exists and its derivatives do not.
    """
    (k,) = extra
    rho2 = x * x + y * y
    root = np.sqrt(z * z - (4.0 * k) * rho2)
    inverse = 2.0 / (z + root)
    if want is Want.VALUE:
        return Plane(x * inverse, y * inverse)
    inverse_root = 1.0 / root
    sideways = (-2.0 * k) * inverse_root
    d_m = (sideways * x, sideways * y, 0.5 + 0.5 * z * inverse_root)
    return _plane(x, y, inverse, d_m, (-rho2 * inverse_root,) if want is Want.D_EXTRA else ())


def eucm_plane(x: FloatArray, y: FloatArray, z: FloatArray, extra: Sequence[float], want: Want) -> Plane:
    """EUCM: m = alpha d + (1 - alpha) Z, d = sqrt(beta rho^2 + Z^2); extra = alpha beta.

    NaN where Z or m is below COLMAP's epsilon, or the root is not real.
    """
    alpha, beta = extra
    z = in_front(z)
    rho2 = x * x + y * y
    root = np.sqrt(beta * rho2 + z * z)
    inverse = 1.0 / in_front(alpha * root + (1.0 - alpha) * z)
    if want is Want.VALUE:
        return Plane(x * inverse, y * inverse)
    inverse_root = 1.0 / root
    sideways = (alpha * beta) * inverse_root
    d_m = (sideways * x, sideways * y, (1.0 - alpha) + alpha * z * inverse_root)
    d_extra = (root - z, (0.5 * alpha) * rho2 * inverse_root) if want is Want.D_EXTRA else ()
    return _plane(x, y, inverse, d_m, d_extra)


def division_depth(r2: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return Z of the ray (x, y, Z) through the distorted normalised point (x, y), r2 = x^2 + y^2; NaN where none."""
    (k,) = extra
    depth = 1.0 + k * r2
    return np.where((depth >= EPSILON) & (k * r2 < 1.0), depth, np.nan)


def eucm_depth(r2: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return Z of the ray (x, y, Z) through the distorted normalised point (x, y), r2 = x^2 + y^2; NaN where none."""
    alpha, beta = extra
    gamma = 1.0 - alpha
    below = alpha * np.sqrt(1.0 - (alpha - gamma) * beta * r2) + gamma
    depth = (1.0 - alpha * alpha * beta * r2) / np.where(below >= EPSILON, below, np.nan)
    return np.where(depth >= EPSILON, depth, np.nan)


def division_folds(extra: Sequence[float], r2: float) -> bool:
    """Whether the division models end before the squared distorted radius ``r2``: k r_d^2 = 1, k > 0."""
    return bool(extra[0] * r2 >= 1.0)
