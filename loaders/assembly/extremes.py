"""Numbers that are finite and yet cannot be true: cameras that no lens is, coordinates that no scene has."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.camera_models import BY_ID, CameraModel
from sfm_audit.loaders.model import CameraTable, Finding, FindingCode, SparseModel

MAX_MAGNITUDE: Final = 1e12
"""Of a coordinate, a quaternion's component, or a stored error; squares and products of three stay finite."""

_FOCAL_OVER_SIZE: Final = (1e-3, 1e4)  # far outside of what is plausible (0.3 to 10): here it is damage, not a bad fit
_MAX_DISTORTION: Final = 1e6


def implausible_cameras(model: SparseModel) -> Finding | None:
    """Cameras with a side of 0 px, a focal length that no lens has, or a distortion parameter above 1e6."""
    cameras = model.cameras
    is_wrong = np.zeros(len(cameras), dtype=np.bool_)
    for model_id in np.unique(cameras.model_id).tolist():
        rows = np.flatnonzero(cameras.model_id == model_id)
        is_wrong[rows] = _are_implausible(cameras, rows, BY_ID[model_id])
    if not is_wrong.any():
        return None
    row, count = int(np.argmax(is_wrong)), int(np.count_nonzero(is_wrong))
    camera = model.camera(row)
    values = ", ".join(f"{value:.4g}" for value in camera.params)
    example = f"camera {camera.camera_id}: {camera.width} x {camera.height} px, {camera.model.name} {values}"
    text = f"{count} of {len(cameras)} cameras have a size or parameters that no camera has, e.g. {example}"
    return Finding(FindingCode.IMPLAUSIBLE_CAMERAS, count, text)


def _are_implausible(cameras: CameraTable, rows: IntArray, model: CameraModel) -> BoolArray:
    """Which cameras (n,) in some rows, all of one model, are implausible; not finite is a finding of its own."""
    width, height = cameras.width[rows], cameras.height[rows]
    params = cameras.params[cameras.param_offsets[rows, None] + np.arange(model.num_params)]
    least, most = _FOCAL_OVER_SIZE
    extra = list(model.extra_idxs)
    others = [i for i in range(model.num_params) if i not in extra]
    with np.errstate(all="ignore"):
        sizes = np.abs(params)
        focal = sizes[:, list(model.focal_idxs)] / np.maximum(width, height)[:, None]
        is_wrong = ~((focal >= least) & (focal <= most)).all(axis=1)
        is_wrong |= (sizes[:, extra] > _MAX_DISTORTION).any(axis=1)
        is_wrong |= (sizes[:, others] > MAX_MAGNITUDE).any(axis=1)
    if model.is_spherical:
        is_wrong |= (sizes[:, others] == 0.0).any(axis=1)
    return np.asarray((np.minimum(width, height) == 0) | (is_wrong & np.isfinite(params).all(axis=1)))


def extreme_values(model: SparseModel) -> Finding | None:
    """Poses, points, 2D points and stored errors with a finite number above `MAX_MAGNITUDE`."""
    images, points, observations = model.images, model.points, model.observations
    poses = np.hstack([images.quat_cam_from_world_wxyz, images.translation_cam_from_world])
    kinds = (
        ("poses", _extreme(poses), "image", images.image_id),
        ("3D points", _extreme(points.xyz_world), "point", points.point3d_id),
        ("stored errors", _extreme(points.stored_error_px[:, None]), "point", points.point3d_id),
    )
    found = [
        (
            int(np.count_nonzero(is_wrong)),
            f"{np.count_nonzero(is_wrong)} {what} (e.g. of {kind} {ids[np.argmax(is_wrong)]})",
        )
        for what, is_wrong, kind, ids in kinds
        if is_wrong.any()
    ]
    is_wrong = _extreme(observations.xy_px)
    if is_wrong.any():
        row = int(np.searchsorted(observations.offsets, int(np.argmax(is_wrong)), side="right")) - 1
        count = int(np.count_nonzero(is_wrong))
        found.append((count, f"{count} linked 2D points (e.g. in image {images.image_id[row]})"))
    if not found:
        return None
    text = f"numbers above {MAX_MAGNITUDE:g} in {', '.join(what for _, what in found)}"
    return Finding(FindingCode.EXTREME_VALUES, sum(count for count, _ in found), text)


def unused_nonfinite(raw: RawModel, poses: FloatArray) -> tuple[Finding, ...]:
    """Numbers that are not finite where nothing is read from: COLMAP refuses a text file with them.

    poses : (I, 7) of the images, which rigs and frames may have replaced
    """
    is_replaced = ~np.isfinite(raw.images.poses).all(axis=1) & np.isfinite(poses).all(axis=1)
    counts = {
        "unlinked 2D points": raw.images.num_unused_nonfinite,
        "colours of 3D points": raw.points.num_unused_nonfinite,
        "poses that rigs and frames replace": int(np.count_nonzero(is_replaced)),
    }
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    if not parts:
        return ()
    text = f"{', '.join(parts)} are no numbers that COLMAP reads in text; they are not used here"
    return (Finding(FindingCode.NON_FINITE_UNUSED, sum(counts.values()), text),)


def _extreme(rows: FloatArray) -> BoolArray:
    """Whether a row has a finite number of too large a magnitude, (n,)."""
    if not rows.size or (rows.max() <= MAX_MAGNITUDE and rows.min() >= -MAX_MAGNITUDE):  # false with NaN
        return np.zeros(len(rows), dtype=np.bool_)
    result: BoolArray = np.any((np.abs(rows) > MAX_MAGNITUDE) & np.isfinite(rows), axis=1)
    return result
