"""What a wrong camera would do to the image: six groups of candidate fields (method.md section 5's E).

Every field is a function of the *predicted* point. The observed point contains the residual, and a field linear in it
explains it perfectly: no function here receives one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.inliers.projected import ProjectedImage
from sfm_audit.audit.table.words import GROUPS, MisfitGroup
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

_MONOMIALS: Final = tuple((degree - j, j) for degree in range(1, 5) for j in range(degree + 1))
_NUM_COLUMNS: Final = {
    MisfitGroup.RADIAL: 2,
    MisfitGroup.TANGENTIAL: 2,
    MisfitGroup.AFFINE: 2,
    MisfitGroup.PRINCIPAL_POINT: 2,
    MisfitGroup.ROLLING_SHUTTER: 6,
    MisfitGroup.SMOOTH: 2 * len(_MONOMIALS),
}
# Where a model's own coefficients act through its other ones, a unit of the coefficient is the unit of the field:
# otherwise FULL_OPENCV with a denominator would not hold the radial group that it has.
OWN_COEFFICIENTS: Final[dict[str, dict[MisfitGroup, tuple[str, str]]]] = {
    "FULL_OPENCV": {MisfitGroup.RADIAL: ("k2", "k3")},
    "RAD_TAN_THIN_PRISM_FISHEYE": {MisfitGroup.RADIAL: ("k1", "k2"), MisfitGroup.TANGENTIAL: ("p1", "p0")},
}


def _slices() -> dict[MisfitGroup, slice]:
    ends = np.cumsum([_NUM_COLUMNS[group] for group in GROUPS])
    return {group: slice(int(end) - _NUM_COLUMNS[group], int(end)) for group, end in zip(GROUPS, ends, strict=True)}


GROUP_COLUMNS: Final[dict[MisfitGroup, slice]] = _slices()
"""Which columns of `candidate_fields` belong to which group."""

NUM_FIELDS: Final = sum(_NUM_COLUMNS.values())


def follows_the_lens(model: CameraModel) -> bool:
    """Whether the candidate fields are those of the list below, without a model's own derivatives in their place."""
    return not model.is_spherical and model.name not in OWN_COEFFICIENTS


def candidate_fields(camera: CameraRecord, projected: ProjectedImage) -> FloatArray:
    """Return E, (42, 2, n) px per unit: the candidate fields of all groups, columns as in `GROUP_COLUMNS`.

    Parameters
    ----------
    camera : its scale, centre and size; spherical models have no fields and give (0, 2, n)
    projected : from `project_image`, of the same camera

    Notes
    -----
    With u the undistorted and v the distorted normalised point, r = |u|, fx on x rows and fy on y rows:

    - radial: u r^4, u r^6                    - tangential: (2 u_x u_y, r^2 + 2 u_y^2), (r^2 + 2 u_x^2, 2 u_x u_y)
    - affine: (v_x, 0), (v_y, 0)              - principal_point: (1, 0), (0, 1)
    - rolling_shutter: pose Jacobian x (row - h / 2) / h
    - smooth: monomials of degree 1..4 of (predicted - (w, h) / 2) / (max(w, h) / 2), in x and in y

    FULL_OPENCV's radial group is its own derivatives in k2 and k3 (and RAD_TAN_THIN_PRISM_FISHEYE's radial and
    tangential ones in k1, k2 and p1, p0): a denominator or a further distortion on top bends u r^4, u r^6 away from
    what the camera can do, and a parameter that it has would be called missing.

    A column that the camera's fitted parameters span already is not removed here: the test's rank finds it.
    """
    n = projected.xy_px.shape[1]
    if camera.model.is_spherical:
        return np.empty((0, 2, n))
    out = np.zeros((NUM_FIELDS, 2, n))
    with np.errstate(over="ignore", invalid="ignore"):  # absurd cameras: the test refuses what is not finite
        _fill_lens(out, camera, projected)
        row = (projected.xy_px[1] - 0.5 * camera.height) / camera.height
        np.multiply(projected.pose, row, out=out[GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]])
        _fill_smooth(out[GROUP_COLUMNS[MisfitGroup.SMOOTH]], camera, projected.xy_px)
    return out


def _fill_lens(out: FloatArray, camera: CameraRecord, projected: ProjectedImage) -> None:
    """Radial, tangential, affine and principal point columns."""
    focals, centre = camera.model.focal_idxs, camera.model.principal_point_idxs
    scale = np.array([[camera.params[focals[0]]], [camera.params[focals[-1]]]])
    ux, uy = projected.u
    r2 = ux * ux + uy * uy
    scaled_u = projected.u * scale
    radial = out[GROUP_COLUMNS[MisfitGroup.RADIAL]]
    np.multiply(scaled_u, r2 * r2, out=radial[0])
    np.multiply(radial[0], r2, out=radial[1])
    tangential = out[GROUP_COLUMNS[MisfitGroup.TANGENTIAL]]
    double_cross = 2.0 * ux * uy
    tangential[0] = double_cross, r2 + 2.0 * uy * uy
    tangential[1] = r2 + 2.0 * ux * ux, double_cross
    tangential *= scale
    vx, vy = (projected.xy_px - camera.params[list(centre)][:, None]) / scale
    affine = out[GROUP_COLUMNS[MisfitGroup.AFFINE]]
    affine[0, 0], affine[1, 0] = scale[0] * vx, scale[0] * vy
    principal_point = out[GROUP_COLUMNS[MisfitGroup.PRINCIPAL_POINT]]
    principal_point[0, 0], principal_point[1, 1] = scale[0], scale[1]
    for group, names in OWN_COEFFICIENTS.get(camera.model.name, {}).items():
        out[GROUP_COLUMNS[group]] = projected.d_params[[camera.model.param_names.index(name) for name in names]]


def _fill_smooth(out: FloatArray, camera: CameraRecord, xy_px: FloatArray) -> None:
    """Monomials of the predicted point, first all in x, then all in y."""
    half = 0.5 * max(camera.width, camera.height)
    x = (xy_px[0] - 0.5 * camera.width) / half
    y = (xy_px[1] - 0.5 * camera.height) / half
    along_x = out[: len(_MONOMIALS), 0]
    along_x[0], along_x[1] = x, y
    for degree in range(2, 5):  # x^d .. x y^(d-1) from the row above times x, then y^d
        first = degree * (degree + 1) // 2 - 1
        above = along_x[first - degree : first]
        np.multiply(above, x, out=along_x[first : first + degree])
        np.multiply(above[-1], y, out=along_x[first + degree])
    out[len(_MONOMIALS) :, 1] = along_x
