"""What a true camera sees. True cameras are richer than the cameras a reconstruction claims.

Every claimed model of a family is a special case of the family's largest member, and defects are set there: the
pinhole models inside FULL_OPENCV, the equidistant fisheyes inside THIN_PRISM_FISHEYE. Both have twelve parameters
and agree on the first nine: fx, fy, cx, cy (px), k1, k2, p1, p2, k3 (dimensionless).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project, unproject
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import BY_NAME, CameraModel

NUM_TRUE_PARAMS: Final = 12
TRUE_PARAM: Final = {"fx": 0, "fy": 1, "cx": 2, "cy": 3, "k1": 4, "k2": 5, "p1": 6, "p2": 7, "k3": 8, "k4": 9}
_SYNONYM: Final = {"f": "fx", "k": "k1"}
_TRUE_MODEL_OF: Final = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"), "FULL_OPENCV"),
    **dict.fromkeys(
        ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
        "THIN_PRISM_FISHEYE",
    ),
}
_ROLLING_SHUTTER_SWEEPS: Final = 50
_ROLLING_SHUTTER_TOLERANCE: Final = 1e-13  # of the image height


@dataclass(frozen=True, slots=True, eq=False)
class TrueCameras:
    """The cameras that took the images; row i of every array is image i.

    model: the true model.                       params: (I, 12) px and dimensionless, see the module's text.
    rotation_cam_from_world: (I, 3, 3).          translation_cam_from_world: (I, 3) model units.
    rolling_shutter: (I, 6) rotation (rad) and translation (model units) of the camera frame from the first to the last
    row: a point seen in row v is at exp(w s) Xc + tau s with s = (v - height / 2) / height.
    """

    model: CameraModel
    width: int
    height: int
    params: FloatArray
    rotation_cam_from_world: FloatArray
    translation_cam_from_world: FloatArray
    rolling_shutter: FloatArray

    def __len__(self) -> int:
        return len(self.params)


def true_model_of(claimed: CameraModel) -> CameraModel:
    """Return the model that holds ``claimed`` and every lens defect; ValueError outside the two families."""
    if claimed.name not in _TRUE_MODEL_OF:
        raise ValueError(f"cannot simulate {claimed.name}; possible: {', '.join(_TRUE_MODEL_OF)}")
    return BY_NAME[_TRUE_MODEL_OF[claimed.name]]


def claimed_params_of(claimed: CameraModel, true_params: FloatArray) -> FloatArray:
    """Return (I, p): the parameters that ``claimed`` has, taken from (I, 12) true ones; f is fx, k is k1."""
    true_names = true_model_of(claimed).param_names
    columns = [true_names.index(_SYNONYM.get(name, name)) for name in claimed.param_names]
    return true_params[:, columns]


def project_claimed(model: CameraModel, params: FloatArray, image_idx: IntArray, xyz_cam: FloatArray) -> FloatArray:
    """Project points of many images, each through its own camera.

    Parameters
    ----------
    params : (I, p) one row per image        image_idx : (m,) rows of params        xyz_cam : (m, 3) model units

    Returns
    -------
    FloatArray
        (m, 2) px, NaN behind the camera.
    """
    order = np.argsort(image_idx, kind="stable")
    bounds = np.searchsorted(image_idx[order], np.arange(len(params) + 1))
    xyz_sorted = xyz_cam[order]
    xy_sorted = np.empty((len(order), 2))
    for i in np.unique(image_idx):
        part = slice(bounds[i], bounds[i + 1])
        xy_sorted[part] = project(model, params[i], xyz_sorted[part])
    xy = np.empty_like(xy_sorted)
    xy[order] = xy_sorted
    return xy


def cam_from_world(rotation: FloatArray, translation: FloatArray, image_idx: IntArray, xyz: FloatArray) -> FloatArray:
    """Return (m, 3): world points (m, 3) in the frames of their images; rotation (I, 3, 3), translation (I, 3)."""
    return np.asarray(np.einsum("mij,mj->mi", rotation[image_idx], xyz) + translation[image_idx])


def project_true(cameras: TrueCameras, image_idx: IntArray, xyz_world: FloatArray) -> FloatArray:
    """Return (m, 2) px: where the images ``image_idx`` (m,) truly see the world points (m, 3); NaN behind."""
    xyz_cam = cam_from_world(cameras.rotation_cam_from_world, cameras.translation_cam_from_world, image_idx, xyz_world)
    xy = project_claimed(cameras.model, cameras.params, image_idx, xyz_cam)
    for i in np.flatnonzero(cameras.rolling_shutter.any(axis=1)):
        rows = np.flatnonzero(image_idx == i)
        xy[rows] = _project_rolling(cameras, int(i), xyz_cam[rows])
    return xy


def _project_rolling(cameras: TrueCameras, i: int, xyz_cam: FloatArray) -> FloatArray:
    """(m, 2) px of points (m, 3) given in the frame of the middle row: fixed point of row -> pose -> row."""
    turn, shift = cameras.rolling_shutter[i, :3], cameras.rolling_shutter[i, 3:]
    phase = np.zeros(len(xyz_cam))
    xy = np.empty((len(xyz_cam), 2))
    for _ in range(_ROLLING_SHUTTER_SWEEPS):
        moved = Rotation.from_rotvec(phase[:, None] * turn).apply(xyz_cam) + phase[:, None] * shift
        xy = project(cameras.model, cameras.params[i], moved)
        new = (xy[:, 1] - 0.5 * cameras.height) / cameras.height
        done = np.isnan(new) | (np.abs(new - phase) < _ROLLING_SHUTTER_TOLERANCE)
        phase = np.where(np.isnan(new), 0.0, np.clip(new, -1.0, 1.0))  # beyond the image: only to stay bounded
        if done.all():
            break
    return xy


def rays_of_pixels(cameras: TrueCameras, image_idx: IntArray, xy_px: FloatArray) -> FloatArray:
    """Return (m, 3): rays with Zc = 1 through the pixels (m, 2), without rolling shutter; NaN where there is none."""
    rays = np.full((len(image_idx), 3), np.nan)
    for i in np.unique(image_idx):
        rows = np.flatnonzero(image_idx == i)
        rays[rows] = unproject(cameras.model, cameras.params[i], xy_px[rows])
    return np.asarray(rays / rays[:, 2:])
