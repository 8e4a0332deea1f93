"""What is wrong with a model that could be read. Nothing is repaired: every check counts and names an example."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.assembly.extremes import extreme_values, implausible_cameras
from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.assembly.track_consistency import find_track_inconsistencies
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import CameraTable, Finding, FindingCode, SparseModel

MAX_NORM_ERROR: Final = 1e-5


def find_inconsistencies(model: SparseModel, raw: RawModel) -> tuple[Finding, ...]:
    """Return the findings of a model, those that compare it with the tracks of ``raw`` included."""
    checks = (
        _empty(model),
        _orphan_cameras(model),
        _missing_cameras(model),
        _non_finite_cameras(model),
        implausible_cameras(model),
        _image_size_swapped(model.cameras),
        _duplicate_names(model),
        _non_finite_poses(model),
        _non_unit_quaternions(model),
        _non_finite_observations(model),
        _observations_outside(model),
        _non_finite_points(model),
        _stored_errors_zero(model),
        _stored_errors_missing(model),
        extreme_values(model),
    )
    return tuple(finding for finding in checks if finding) + find_track_inconsistencies(model, raw.points)


def _empty(model: SparseModel) -> Finding | None:
    missing = [name for name, table in (("images", model.images), ("3D points", model.points)) if not len(table)]
    text = f"the model has no {' and no '.join(missing)}"
    return Finding(FindingCode.EMPTY_MODEL, len(missing), text) if missing else None


def _orphan_cameras(model: SparseModel) -> Finding | None:
    is_orphan = ~np.isin(model.cameras.camera_id, model.images.camera_id)
    text = "{count} of {total} cameras belong to no image, e.g. camera {example}"
    return _of_rows(FindingCode.ORPHAN_CAMERAS, text, is_orphan, model.cameras.camera_id)


def _missing_cameras(model: SparseModel) -> Finding | None:
    rows = np.flatnonzero(model.images.camera_idx < 0)
    if not len(rows):
        return None
    image_id, camera_id = model.images.image_id[rows[0]], model.images.camera_id[rows[0]]
    text = f"{len(rows)} of {len(model.images)} images have a camera that does not exist, e.g. image {image_id}"
    return Finding(FindingCode.MISSING_CAMERAS, len(rows), f"{text} camera {camera_id}")


def _non_finite_cameras(model: SparseModel) -> Finding | None:
    cameras = model.cameras
    owner = np.repeat(np.arange(len(cameras)), np.diff(cameras.param_offsets))
    is_wrong = np.zeros(len(cameras), dtype=np.bool_)
    is_wrong[owner[~np.isfinite(cameras.params)]] = True
    text = "{count} of {total} cameras have parameters that are not finite, e.g. camera {example}"
    return _of_rows(FindingCode.NON_FINITE_CAMERAS, text, is_wrong, cameras.camera_id)


def _image_size_swapped(cameras: CameraTable) -> Finding | None:
    """The principal point is (h / 2, w / 2), or lies in the image only after swapping its width and height."""
    cx, cy = principal_points(cameras).T
    w, h = cameras.width, cameras.height
    at_swapped_centre = (cx == h / 2) & (cy == w / 2)
    is_inside = (cx >= 0) & (cx <= w) & (cy >= 0) & (cy <= h)
    is_inside_swapped = (cx >= 0) & (cx <= h) & (cy >= 0) & (cy <= w)
    is_swapped = (w != h) & (at_swapped_centre | (is_inside_swapped & ~is_inside))
    text = "{count} of {total} cameras seem to have width and height swapped: their principal point says so, "
    return _of_rows(FindingCode.IMAGE_SIZE_SWAPPED, text + "e.g. camera {example}", is_swapped, cameras.camera_id)


def principal_points(cameras: CameraTable) -> FloatArray:
    """Return (C, 2) principal points, px; NaN for camera models that have none."""
    by_id = np.full((max(BY_ID) + 1, 2), -1, dtype=np.int64)
    for model_id, model in BY_ID.items():
        by_id[model_id] = model.principal_point_idxs or (-1, -1)
    at = by_id[cameras.model_id]
    with_nan = np.append(cameras.params, np.nan)
    return with_nan[np.where(at < 0, len(cameras.params), cameras.param_offsets[:-1, None] + at)]


def _duplicate_names(model: SparseModel) -> Finding | None:
    repeated = {name: count for name, count in Counter(model.images.name).items() if count > 1}
    if not repeated:
        return None
    count = sum(repeated.values())
    text = f"{count} of {len(model.images)} images share their name with another one, e.g. {next(iter(repeated))!r}"
    return Finding(FindingCode.DUPLICATE_NAMES, count, text)


def _non_finite_poses(model: SparseModel) -> Finding | None:
    text = "{count} of {total} images have a pose that is not finite, e.g. image {example}"
    return _of_rows(FindingCode.NON_FINITE_POSES, text, ~_has_finite_pose(model), model.images.image_id)


def _has_finite_pose(model: SparseModel) -> BoolArray:
    poses = np.hstack([model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world])
    return all_finite(poses)


def all_finite(rows: FloatArray) -> BoolArray:
    """Return (n,): whether every number of a row is finite."""
    result: BoolArray = np.logical_and.reduce(np.isfinite(rows), axis=1)
    return result


def _non_unit_quaternions(model: SparseModel) -> Finding | None:
    with np.errstate(invalid="ignore", over="ignore"):  # poses that are not finite have their own finding
        norms = np.sqrt(np.sum(model.images.quat_cam_from_world_wxyz**2, axis=1))
        is_wrong = (np.abs(norms - 1) > MAX_NORM_ERROR) & _has_finite_pose(model)
    text = "{count} of {total} images have a rotation quaternion of length other than 1, e.g. image {example}"
    return _of_rows(FindingCode.NON_UNIT_QUATERNIONS, text, is_wrong, model.images.image_id)


def _non_finite_observations(model: SparseModel) -> Finding | None:
    if _sums_up(model.observations.xy_px):
        return None
    is_wrong = ~all_finite(model.observations.xy_px)
    text = "{count} of {total} linked 2D points are not finite, e.g. in image {example}"
    return _of_observations(FindingCode.NON_FINITE_OBSERVATIONS, text, is_wrong, model)


def _observations_outside(model: SparseModel) -> Finding | None:
    images, cameras = model.images, model.cameras
    num_outside = np.zeros(len(images), dtype=np.int64)
    for image_idx, (first, last) in enumerate(pairwise(model.observations.offsets.tolist())):
        camera_idx = images.camera_idx[image_idx]
        xy = model.observations.xy_px[first:last]
        if camera_idx < 0 or not len(xy):
            continue
        limit = np.array([cameras.width[camera_idx], cameras.height[camera_idx]])
        is_inside = xy.min() >= 0 and xy[:, 0].max() <= limit[0] and xy[:, 1].max() <= limit[1]  # false with NaN
        if not is_inside:
            is_outside = np.logical_or.reduce((xy < 0) | (xy > limit), axis=1) & all_finite(xy)
            num_outside[image_idx] = np.count_nonzero(is_outside)
    if not np.any(num_outside):
        return None
    count, total = int(num_outside.sum()), len(model.observations)
    example = images.image_id[int(np.argmax(num_outside > 0))]
    text = f"{count} of {total} linked 2D points lie outside of their image, e.g. in image {example}"
    return Finding(FindingCode.OBSERVATIONS_OUTSIDE, count, text)


def _sums_up(values: FloatArray) -> bool:
    """Whether one number tells that all are finite: the usual case."""
    with np.errstate(invalid="ignore", over="ignore"):
        return bool(np.isfinite(np.sum(values)))


def _non_finite_points(model: SparseModel) -> Finding | None:
    if _sums_up(model.points.xyz_world):
        return None
    is_wrong = ~all_finite(model.points.xyz_world)
    text = "{count} of {total} 3D points are not finite, e.g. point {example}"
    return _of_rows(FindingCode.NON_FINITE_POINTS, text, is_wrong, model.points.point3d_id)


def _stored_errors_zero(model: SparseModel) -> Finding | None:
    errors = model.points.stored_error_px
    if not len(errors) or np.any(errors != 0):
        return None
    return Finding(FindingCode.STORED_ERRORS_ZERO, len(errors), f"the stored errors of all {len(errors)} points are 0")


def _stored_errors_missing(model: SparseModel) -> Finding | None:
    is_missing = ~(model.points.stored_error_px >= 0) | ~np.isfinite(model.points.stored_error_px)
    text = "{count} of {total} 3D points have no stored error, e.g. point {example}"
    return _of_rows(FindingCode.STORED_ERRORS_MISSING, text, is_missing, model.points.point3d_id)


def _of_rows(code: FindingCode, text: str, is_wrong: BoolArray, ids: np.ndarray) -> Finding | None:
    count = int(np.count_nonzero(is_wrong))
    if not count:
        return None
    example = ids[int(np.argmax(is_wrong))]
    return Finding(code, count, text.format(count=count, total=len(is_wrong), example=example))


def _of_observations(code: FindingCode, text: str, is_wrong: BoolArray, model: SparseModel) -> Finding | None:
    count = int(np.count_nonzero(is_wrong))
    if not count:
        return None
    first = int(np.argmax(is_wrong))
    image = int(np.searchsorted(model.observations.offsets, first, side="right")) - 1
    example = model.images.image_id[image]
    return Finding(code, count, text.format(count=count, total=len(is_wrong), example=example))
