"""One image from arrays of the user's own: points, camera and pose, audited without a model around them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.image import ImageAudit, audit_inliers
from sfm_audit.audit.notebook.result import quietly
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord, InlierSet

if TYPE_CHECKING:
    import pycolmap

NamedCamera = tuple[str, int, int, Sequence[float]]
_MAX_SIDE: Final = 2**32
_ORTHONORMAL: Final = 1e-6  # a rotation that was stored in float32 is off by 1e-7


def audit_correspondences(
    xy: ArrayLike,
    xyz: ArrayLike,
    camera: CameraRecord | NamedCamera | pycolmap.Camera,
    pose: ArrayLike | pycolmap.Rigid3d,
    *,
    config: AuditConfig | None = None,
    name: str = "correspondences",
) -> ImageAudit:
    """Audit one camera against its own 2D-3D inliers; the 3D points are taken as independent of this image.

    Parameters
    ----------
    xy : (n, 2) observed points, px of the distorted image, centre of the first pixel at (0.5, 0.5)
    xyz : (n, 3) their 3D points, row by row, world frame, any unit
    camera : a `CameraRecord`, a ``pycolmap.Camera``, or (name of COLMAP's model, width, height, parameters)
    pose : cam_from_world: (3, 4) or (4, 4) [R | t], or a ``pycolmap.Rigid3d``; x right, y down, z forward
    config : thresholds and policy; the defaults when None
    name : what the image is called in the answer

    Returns
    -------
    ImageAudit
        Verdict, reasons, residuals and tests; tracks and neighbours were not asked.

    Raises
    ------
    ValueError
        An array has another shape, or is no pose or no camera; one line says which, and what was expected.

    Examples
    --------
    >>> rng = np.random.default_rng(5)
    >>> xyz = rng.uniform([-3, -2, 4], [3, 2, 12], (400, 3))
    >>> exact = 800 * xyz[:, :2] / xyz[:, 2:] + [640, 480]
    >>> xy = exact + rng.normal(0, 0.5, exact.shape)
    >>> camera, pose = ("SIMPLE_PINHOLE", 1280, 960, (800, 640, 480)), np.eye(3, 4)
    >>> audit_correspondences(xy, xyz, camera, pose).verdict
    <Verdict.ACCEPTED: 'accepted'>
    >>> audit_correspondences(xy[:100], xyz, camera, pose)
    Traceback (most recent call last):
    ValueError: xyz: expected shape (100, 3), a row for each of xy, found (400, 3)
    """
    xy_px, xyz_world = _points(xy, xyz)
    quat_wxyz, translation = _pose(pose)
    record = _camera(camera)
    image = ImageRecord(1, name, record.camera_id, record, quat_wxyz, translation, len(xy_px))
    inliers = InlierSet(image, xy_px, xyz_world, np.arange(len(xy_px), dtype=np.int64))
    with quietly():
        return audit_inliers(inliers, config)


def _points(xy: ArrayLike, xyz: ArrayLike) -> tuple[FloatArray, FloatArray]:
    xy_px, xyz_world = _array(xy, "xy"), _array(xyz, "xyz")
    if xy_px.ndim != 2 or xy_px.shape[1] != 2:
        raise ValueError(f"xy: expected shape (n, 2), found {xy_px.shape}")
    if xyz_world.shape != (len(xy_px), 3):
        raise ValueError(f"xyz: expected shape ({len(xy_px)}, 3), a row for each of xy, found {xyz_world.shape}")
    return xy_px, xyz_world


def _array(values: ArrayLike, name: str) -> FloatArray:
    if np.ma.is_masked(values):
        raise ValueError(f"{name}: expected numbers without a mask, found masked ones; leave their rows out")
    try:
        given = np.asarray(values)
    except ValueError:
        raise ValueError(f"{name}: expected numbers in rows of one length, found other lengths") from None
    if given.dtype.kind == "O" and given.size and all(isinstance(each, int | float | np.number) for each in given.flat):
        given = given.astype(np.float64)
    if given.dtype.kind not in "iuf":
        what = "text" if given.dtype.kind in "US" else given.dtype.name
        found = type(values).__name__ if given.ndim == 0 else f"an array of {what}"
        raise ValueError(f"{name}: expected numbers in rows of one length, found {found}")
    return np.ascontiguousarray(given, dtype=np.float64)


def _is_of(value: Any, name: str) -> bool:
    """Whether ``value`` is one of pycolmap's ``name``; whoever has one has imported pycolmap."""
    pycolmap = sys.modules.get("pycolmap")
    return pycolmap is not None and isinstance(value, getattr(pycolmap, name))


def _pose(pose: Any) -> tuple[FloatArray, FloatArray]:
    """Quaternion w x y z and translation."""
    matrix = _array(pose.matrix() if _is_of(pose, "Rigid3d") else pose, "pose")
    if matrix.shape not in {(3, 4), (4, 4)}:
        raise ValueError(f"pose: expected shape (3, 4) or (4, 4), [R | t] of cam_from_world, found {matrix.shape}")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=_ORTHONORMAL):
        raise ValueError(f"pose: expected 0 0 0 1 as its last row, found {' '.join(f'{v:g}' for v in matrix[3])}")
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not (off <= _ORTHONORMAL and np.linalg.det(rotation) > 0):
        raise ValueError(f"pose: expected a rotation in its first three columns, found R R^T off 1 by {off:.2g}")
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z]), matrix[:3, 3].copy()


def _is_side(value: Any) -> bool:
    """Whether a value is a number of px, as 1280 or 1280.0."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return is_number and float(value).is_integer() and 0 < float(value) < _MAX_SIDE


def _camera(camera: Any) -> CameraRecord:
    if isinstance(camera, CameraRecord):
        return camera
    if _is_of(camera, "Camera"):
        camera = camera.model.name, camera.width, camera.height, camera.params
    if not isinstance(camera, list | tuple) or len(camera) != 4:
        wanted = "a CameraRecord, a pycolmap.Camera, or (model, width, height, params)"
        raise ValueError(f"camera: expected {wanted}, found {type(camera).__name__}")
    model_name, width, height, params = camera
    model = BY_NAME.get(str(getattr(model_name, "name", model_name)))
    if model is None:
        raise ValueError(f"camera: expected a model of COLMAP's ({', '.join(BY_NAME)}), found {model_name!r:.60}")
    if not (_is_side(width) and _is_side(height)):
        raise ValueError(f"camera: expected a width and a height in whole px, found {width!r:.40} and {height!r:.40}")
    values = _array(params, "camera")
    if values.shape != (model.num_params,):
        names = " ".join(model.param_names)
        raise ValueError(
            f"camera: expected {model.num_params} parameters of {model.name} ({names}), found {values.shape}"
        )
    return CameraRecord(1, model, int(width), int(height), values)
