"""Zhang's method with OpenCV: a camera from several views of a flat board, models M1 to M5 of the paper's table 1.

Needs the extra ``calibrate``. The reference that estimates from a single image are compared with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, get_args

import cv2
import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

ZhangModel = Literal["M1", "M2", "M3", "M4", "M5"]
MODELS: Final = MappingProxyType(
    {
        "M1": ("f", "k1"),
        "M2": ("f", "cx", "cy", "k1"),
        "M3": ("f", "k1", "k2", "k3"),
        "M4": ("f", "cx", "cy", "k1", "k2", "k3"),
        "M5": ("fx", "fy", "cx", "cy", "k1", "k2", "k3"),
    }
)
"""What each of the paper's models estimates; the others are 0, the image's middle, and fx = fy."""
_SD_ROW: Final = MappingProxyType({"fx": 0, "f": 1, "fy": 1, "cx": 2, "cy": 3, "k1": 4, "k2": 5, "k3": 8})
"""Where OpenCV has a parameter's standard deviation; with one focal length it estimates fy."""
_MIN_VIEWS: Final = 3  # five unknowns of M5's pinhole, two equations a view
_MIN_CORNERS: Final = 6
_NUM_POSE: Final = 6
_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@dataclass(frozen=True, slots=True, eq=False)
class ZhangResult:
    """A camera from several views, and how well it explains views that it has not seen.

    sd_px: standard deviation, per axis, of the residuals of the held-out views, whose poses alone are fitted (their six
    degrees of freedom a view are taken off).          train_sd_px: of the views used (all parameters taken off).
    train_rms_px: sqrt of the mean squared *distance*, which is what OpenCV returns.
    parameter_sd: of ``camera.estimated``, OpenCV's.       residuals_px: (m, 2) of the held-out views, in their order.
    """

    model: str
    camera: CalibratedCamera
    num_views: int
    num_held_out: int
    sd_px: float
    train_sd_px: float
    train_rms_px: float
    parameter_sd: tuple[float, ...]
    residuals_px: FloatArray


def zhang(views: Sequence[Correspondences], model: ZhangModel, held_out: Sequence[Correspondences]) -> ZhangResult:
    """Calibrate on views of a flat board and judge the camera on others.

    Parameters
    ----------
    views, held_out : of one camera, at least 3 and 1; each in the frame of its board: z = 0, any unit

    Raises
    ------
    DegenerateInputError
        Too few views or corners, values that are not finite, or views from which OpenCV finds no camera.
    ValueError
        An unknown model, views of different sizes, points off the plane z = 0.

    Notes
    -----
    cv2.calibrateCameraExtended with flags; OpenCV's first pixel centre is (0, 0), ours (0.5, 0.5).
    """
    if model not in MODELS:
        raise ValueError(f"unknown model {model!r}; there are {', '.join(get_args(ZhangModel))}")
    _check(views, held_out)
    first = views[0]
    # FIX_ASPECT_RATIO keeps the ratio of the matrix that comes in
    try:
        rms, matrix, distortion, _, _, sds, _, _ = cv2.calibrateCameraExtended(
            [view.xyz_world.astype(np.float32) for view in views],
            [(view.xy_px - 0.5).astype(np.float32) for view in views],
            (first.width, first.height),
            np.eye(3),
            np.zeros(5),
            flags=_flags(MODELS[model]),
            criteria=_CRITERIA,
        )
    except cv2.error as error:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, f"OpenCV: {error.err}") from error
    camera = _camera(np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel(), first, MODELS[model])
    residuals = np.concatenate([_residuals(camera, view) for view in held_out])
    num_values = 2 * sum(view.num for view in views)
    num_parameters = len(camera.estimated) + _NUM_POSE * len(views)
    return ZhangResult(
        model,
        camera,
        len(views),
        len(held_out),
        float(np.sqrt((residuals**2).sum() / (residuals.size - _NUM_POSE * len(held_out)))),
        float(rms * np.sqrt(0.5 * num_values / (num_values - num_parameters))),
        float(rms),
        tuple(float(sds.ravel()[_SD_ROW[name]]) for name in camera.estimated),
        residuals,
    )


def _check(views: Sequence[Correspondences], held_out: Sequence[Correspondences]) -> None:
    if len(views) < _MIN_VIEWS or not held_out:
        detail = f"{len(views)} views and {len(held_out)} held out; need {_MIN_VIEWS} and 1"
        raise DegenerateInputError(Degeneracy.TOO_FEW_POINTS, detail)
    for view in (*views, *held_out):
        if view.num < _MIN_CORNERS:
            detail = f"a view of {view.num} corners; need {_MIN_CORNERS}"
            raise DegenerateInputError(Degeneracy.TOO_FEW_POINTS, detail)
        if not (np.isfinite(view.xy_px).all() and np.isfinite(view.xyz_world).all()):
            raise DegenerateInputError(Degeneracy.NOT_FINITE, "a view with values that are not finite")
        if view.xyz_world[:, 2].any():
            raise ValueError("the points of a view must lie in its plane z = 0")
        if (view.width, view.height) != (views[0].width, views[0].height):
            raise ValueError("all views must have the size of the first")


def _flags(estimated: Sequence[str]) -> int:
    """OpenCV's flags for what is *not* estimated."""
    flags = cv2.CALIB_ZERO_TANGENT_DIST
    for name, flag in (("k1", cv2.CALIB_FIX_K1), ("k2", cv2.CALIB_FIX_K2), ("k3", cv2.CALIB_FIX_K3)):
        flags |= 0 if name in estimated else flag
    flags |= 0 if "cx" in estimated else cv2.CALIB_FIX_PRINCIPAL_POINT
    return flags | (cv2.CALIB_FIX_ASPECT_RATIO if "f" in estimated else 0)


def _camera(
    matrix: FloatArray, distortion: FloatArray, view: Correspondences, estimated: tuple[str, ...]
) -> CalibratedCamera:
    """Turn OpenCV's numbers (distortion k1, k2, p1, p2, k3) into ours."""
    return CalibratedCamera(
        view.width,
        view.height,
        Distortion.FORWARD,
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5),
        distortion[[0, 1, 4]],
        estimated,
    )


def _residuals(camera: CalibratedCamera, view: Correspondences) -> FloatArray:
    """(n, 2) px: observed - projected, with the pose that fits the view best."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_point_px
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    k1, k2, k3 = camera.coefficients
    distortion = np.array([k1, k2, 0.0, 0.0, k3])
    xy_cv = view.xy_px - 0.5
    try:
        found, turn, shift = cv2.solvePnP(view.xyz_world, xy_cv, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
        turn, shift = cv2.solvePnPRefineLM(view.xyz_world, xy_cv, matrix, distortion, turn, shift, _CRITERIA)
    except cv2.error as error:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, f"OpenCV: {error.err}") from error
    if not found:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, "OpenCV finds no pose of a held-out view")
    rotation, _ = cv2.Rodrigues(turn)
    return np.asarray(view.xy_px - camera.project(view.xyz_world @ rotation.T + shift.ravel()).xy_px.T)
