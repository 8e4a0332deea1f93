"""EQUIRECTANGULAR: the whole sphere on one image; longitude across, latitude down; parameters w, h in px."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sfm_audit.audit.cameras.columns import EPSILON, Plane, Want
from sfm_audit.loaders.arrays import FloatArray


def spherical_plane(x: FloatArray, y: FloatArray, z: FloatArray, extra: Sequence[float], want: Want) -> Plane:
    """Return the position as a share of the image: (1/2 + longitude / 2 pi, 1/2 + latitude / pi).

    longitude = atan2(X, Z), latitude = atan2(Y, sqrt(X^2 + Z^2)), positive downwards. NaN only for (almost) no
    direction at all, sqrt(X^2 + Z^2) + |Y| below COLMAP's epsilon. At the two poles the derivatives are NaN: there
    the longitude has none.
    """
    del extra
    across2 = x * x + z * z
    across = np.sqrt(across2)
    across[across + np.abs(y) < EPSILON] = np.nan
    share_x = np.arctan2(x, z) / (2.0 * math.pi) + 0.5
    share_y = np.arctan2(y, across) / math.pi + 0.5
    share_x[np.isnan(across)] = np.nan
    if want is Want.VALUE:
        return Plane(share_x, share_y)
    across2[across2 == 0.0] = np.nan
    along = 1.0 / (2.0 * math.pi * across2)
    down = 1.0 / (math.pi * (across2 + y * y))
    lift = -y * down / across
    d_x = (z * along, np.where(np.isnan(across2), np.nan, 0.0), -x * along)
    d_y = (x * lift, across * down, z * lift)
    return Plane(share_x, share_y, d_x + d_y)


def spherical_rays(share_x: FloatArray, share_y: FloatArray, extra: Sequence[float]) -> FloatArray:
    """Return (n, 3) unit rays of positions given as shares of the image; NaN outside [0, 1]."""
    del extra
    inside = (share_x >= 0.0) & (share_x <= 1.0) & (share_y >= 0.0) & (share_y <= 1.0)
    longitude = (2.0 * math.pi) * (np.where(inside, share_x, np.nan) - 0.5)
    latitude = math.pi * (share_y - 0.5)
    across = np.cos(latitude)
    down = np.where(inside, np.sin(latitude), np.nan)
    return np.column_stack([across * np.sin(longitude), down, across * np.cos(longitude)])
