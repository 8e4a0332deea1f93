"""Models that divide by the depth: pinhole, radial, tangential, FOV (a distortion of the plane Z = 1)."""

from __future__ import annotations

from collections.abc import Sequence

from sfm_audit.audit.cameras.columns import Plane, Want, in_front
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.loaders.arrays import FloatArray


def perspective_plane(
    x_cam: FloatArray, y_cam: FloatArray, z_cam: FloatArray, warp: WarpFunction, extra: Sequence[float], *, want: Want
) -> Plane:
    """Distort (X, Y) / Z; NaN where Z is below COLMAP's epsilon.

    d/dX = D_u / Z, d/dY = D_v / Z, d/dZ = -(u D_u + v D_v) / Z with D the 2 x 2 derivative of the distortion.
    """
    inverse = 1.0 / in_front(z_cam)
    u, v = x_cam * inverse, y_cam * inverse
    x, y, xu, xv, yu, yv, d_extra = warp(u, v, extra, want)
    if want is Want.VALUE:
        return Plane(x, y)
    minus = -inverse
    d_x = (xu * inverse, xv * inverse, (xu * u + xv * v) * minus)
    d_y = (yu * inverse, yv * inverse, (yu * u + yv * v) * minus)
    return Plane(x, y, d_x + d_y, d_extra)
