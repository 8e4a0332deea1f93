"""From latitude, longitude and altitude to a Cartesian frame: WGS84 to east, north, up about a point.

Closed formulas (NIMA TR8350.2; EPSG method 9836); the same numbers as pycolmap's GPSTransform.ellipsoid_to_enu, which
is in the tests. pyproj would bring PROJ and its database for them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

SEMI_MAJOR_M: Final = 6378137.0
FLATTENING: Final = 1.0 / 298.257223563
_E2: Final = FLATTENING * (2.0 - FLATTENING)


def ecef_of(lat_lon_alt: FloatArray) -> FloatArray:
    """Return (n, 3) earth-centred positions, m, of (n, 3) latitudes and longitudes in degrees and altitudes in m."""
    lat, lon = np.radians(lat_lon_alt[:, 0]), np.radians(lat_lon_alt[:, 1])
    alt = lat_lon_alt[:, 2]
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    around = (normal + alt) * np.cos(lat)
    return np.stack([around * np.cos(lon), around * np.sin(lon), (normal * (1.0 - _E2) + alt) * np.sin(lat)], axis=1)


def enu_of(lat_lon_alt: FloatArray, origin: FloatArray) -> FloatArray:
    """Return (n, 3) east, north, up in m about an origin (3,), both as latitude, longitude, altitude."""
    lat, lon = np.radians(origin[:2])
    rows = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    enu: FloatArray = (ecef_of(lat_lon_alt) - ecef_of(origin[None])) @ rows.T
    return enu
