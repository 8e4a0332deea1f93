"""From pixels back to rays, for every camera model."""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.cameras.projection import check_shapes, extras, scales_and_shifts
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import CameraModel


def unproject(model: CameraModel, params: FloatArray, xy_px: FloatArray) -> FloatArray:
    """Return the rays that ``project`` sends to the given pixels.

    Parameters
    ----------
    model : CameraModel
    params : (p,)     in COLMAP's order, px and dimensionless; (p, n) where pixels have their own, not of FOV
    xy_px : (n, 2)    px in the distorted image

    Returns
    -------
    (n, 3)
        Unit vectors in the camera frame, Zc > 0 except for spherical models (divide by Zc for the point at depth 1).
        NaN where no ray was found: beyond the reach or the fold of the distortion, rays that leave backwards
        (fisheye: theta >= 90 degrees), pixels outside a panorama, pixels that are not finite.

    Raises
    ------
    ValueError
        when the shapes are not (p,) and (n, 2).

    Notes
    -----
    Newton's method walks out from the optical axis in short steps. A solution counts if the distortion is not folded
    (determinant of its derivative positive) at 16 places on the way there: of several rays that is the one on the
    axis' side of every fold. pycolmap's ``cam_from_img`` starts at the distorted point and may answer from beyond.
    """
    check_shapes(model, params, xy_px, 2)
    fx, fy, cx, cy = scales_and_shifts(model, params)
    with np.errstate(all="ignore"):
        x, y = (xy_px[:, 0] - cx) / fx, (xy_px[:, 1] - cy) / fy
        return functions_of(model).rays(x, y, extras(model, params))
