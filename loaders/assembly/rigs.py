"""Poses of images from frames and rigs (COLMAP 3.12 and newer)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.assembly.raw import CAMERA_SENSOR, IDENTITY_POSE, Pose, RawFrame, RawImages, RawModel, RawRig
from sfm_audit.loaders.model import Finding, FindingCode, rotation_from_quat

MAX_TURN_DEG: Final = 0.01
MAX_SHIFT: Final = 1e-3
"""Between the two poses of an image, degrees and shares of the extent of all centres: more than rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class _FramePoses:
    """Per image: sensor_from_rig and rig_from_world and the frame they are of, and why an image has none."""

    rows: list[int]
    frame_ids: list[int]
    sensor_from_rig: list[Pose]
    rig_from_world: list[Pose]
    problems: dict[int, str]


def compose(cam_from_rig: FloatArray, rig_from_world: FloatArray) -> FloatArray:
    """Return (n, 7) poses cam_from_rig * rig_from_world.

    Quaternions are multiplied as stored (Hamilton product), not normalised; the translation of the right factor is
    turned by the left quaternion the way Eigen does it: v + 2 w (q x v) + 2 q x (q x v). COLMAP: Rigid3d operator*.
    """
    a_w, a_q, a_t = cam_from_rig[:, :1], cam_from_rig[:, 1:4], cam_from_rig[:, 4:]
    b_w, b_q, b_t = rig_from_world[:, :1], rig_from_world[:, 1:4], rig_from_world[:, 4:]
    w = a_w * b_w - np.sum(a_q * b_q, axis=1, keepdims=True)
    q = a_w * b_q + b_w * a_q + np.cross(a_q, b_q)
    twice = 2 * np.cross(a_q, b_t)
    return np.hstack([w, q, b_t + a_w * twice + np.cross(a_q, twice) + a_t])


@dataclass(frozen=True, slots=True, eq=False)
class PlacedImages:
    """cam_from_world (I, 7) of all images; frame_idx and pose_cam_from_rig as in `ImageTable`."""

    poses: FloatArray
    frame_idx: IntArray | None = None
    pose_cam_from_rig: FloatArray | None = None


def compose_poses(raw: RawModel) -> tuple[PlacedImages, tuple[Finding, ...]]:
    """Return the poses of all images.

    With rigs and frames the poses of the images file are ignored, as in COLMAP. An image that they do not place
    keeps the pose of the images file, and a finding says so.
    """
    images, rigs, frames = raw.images, raw.rigs, raw.frames
    if rigs is None or frames is None:
        return PlacedImages(images.poses), _one_file_missing(rigs, frames)
    if not rigs and not frames:
        return PlacedImages(images.poses), ()
    parts = _frame_poses(images, rigs, frames)
    poses = images.poses.copy()
    if parts.rows:
        with np.errstate(invalid="ignore", over="ignore"):  # a non-finite pose is a finding, not an error
            poses[parts.rows] = compose(np.array(parts.sensor_from_rig), np.array(parts.rig_from_world))
    findings = (
        *(_not_placed(images, parts.problems), _not_there(images, frames), _sensors_disagree(raw, rigs, frames)),
        _other_poses(images, poses),
    )
    return _placed(poses, parts), tuple(finding for some in findings for finding in some)


def _placed(poses: FloatArray, parts: _FramePoses) -> PlacedImages:
    """Say which images go together, where any two do."""
    if len(set(parts.frame_ids)) == len(parts.frame_ids):
        return PlacedImages(poses)
    key = np.arange(len(poses), dtype=np.int64)  # of an image that is not placed, nobody else's
    key[parts.rows] = len(poses) + np.unique(parts.frame_ids, return_inverse=True)[1]
    cam_from_rig = np.tile(np.array(IDENTITY_POSE), (len(poses), 1))
    cam_from_rig[parts.rows] = parts.sensor_from_rig
    return PlacedImages(poses, np.unique(key, return_inverse=True)[1].astype(np.int64), cam_from_rig)


def _frame_poses(images: RawImages, rigs: Sequence[RawRig], frames: Sequence[RawFrame]) -> _FramePoses:
    rig_of = {rig.rig_id: rig for rig in rigs}
    frames_of: dict[int, list[RawFrame]] = {}
    for frame in frames:
        for image_id in frame.image_ids:
            frames_of.setdefault(image_id, []).append(frame)
    parts = _FramePoses([], [], [], [], {})
    ids = zip(images.image_id.tolist(), images.camera_id.tolist(), strict=True)
    for row, (image_id, camera_id) in enumerate(ids):
        owners = frames_of.get(image_id, [])
        rig = rig_of.get(owners[0].rig_id) if owners else None
        sensor = (CAMERA_SENSOR, camera_id)
        if len(owners) != 1:
            parts.problems[row] = f"is in {len(owners)} frames" if owners else "is in no frame"
        elif rig is None:
            parts.problems[row] = f"is in a frame of rig {owners[0].rig_id}, which does not exist"
        elif sensor not in rig.sensor_from_rig:
            parts.problems[row] = f"has camera {camera_id}, which is not in rig {rig.rig_id}"
        else:
            sensor_from_rig = rig.sensor_from_rig[sensor]
            if sensor_from_rig is None:
                parts.problems[row] = f"has camera {camera_id}, which has no pose in rig {rig.rig_id}"
            else:
                parts.rows.append(row)
                parts.frame_ids.append(owners[0].frame_id)
                parts.sensor_from_rig.append(sensor_from_rig)
                parts.rig_from_world.append(owners[0].rig_from_world)
    return parts


def _not_placed(images: RawImages, problems: dict[int, str]) -> tuple[Finding, ...]:
    if not problems:
        return ()
    row, problem = next(iter(problems.items()))
    count = len(problems)
    text = (
        f"{count} of {len(images.image_id)} images are not placed by rigs and frames and keep the pose of the images "
        f"file, e.g. image {images.image_id[row]} {problem}"
    )
    return (Finding(FindingCode.INCOMPLETE_RIGS, count, text),)


def _other_poses(images: RawImages, placed: FloatArray) -> tuple[Finding, ...]:
    """Compare the poses of the images file with those that frames and rigs place; the latter are read."""
    if not len(placed):
        return ()
    with np.errstate(all="ignore"):
        own, read = (
            rotation_from_quat(each[:, :4] / np.linalg.norm(each[:, :4], axis=1, keepdims=True))
            for each in (images.poses, placed)
        )
        cosine = (np.einsum("nij,nij->n", own, read) - 1.0) / 2.0
        turned_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        centre, other = (-np.einsum("nji,nj->ni", r, each[:, 4:]) for r, each in ((read, placed), (own, images.poses)))
        extent = np.linalg.norm(centre - np.median(centre, axis=0), axis=1)
        scale = max(float(np.median(extent[np.isfinite(extent)])), 1e-9) if np.isfinite(extent).any() else np.nan
        shifted = np.linalg.norm(other - centre, axis=1) / scale
        differs = (turned_deg > MAX_TURN_DEG) | (shifted > MAX_SHIFT)
    count = int(np.count_nonzero(differs))
    if not count:
        return ()
    worst = int(np.nanargmax(np.where(differs, turned_deg, -1.0)))
    moved = shifted[differs & np.isfinite(shifted)]  # none where all cameras are in one place
    far = f", {moved.max():.3g} of the cameras' extent" if moved.size else ""
    text = (
        f"the images file has other poses than frames and rigs, which were read, for {count} of {len(placed)} images: "
        f"up to {turned_deg[worst]:.3g} degrees (image {images.image_id[worst]}){far}; programs that read the images "
        f"file alone see another model"
    )
    return (Finding(FindingCode.RIG_POSE_DISAGREES, count, text),)


def _not_there(images: RawImages, frames: Sequence[RawFrame]) -> tuple[Finding, ...]:
    known = set(images.image_id.tolist())
    lost = sorted({image_id for frame in frames for image_id in frame.image_ids} - known)
    if not lost:
        return ()
    text = f"frames consist of {len(lost)} images that do not exist, e.g. image {lost[0]}"
    return (Finding(FindingCode.INCOMPLETE_RIGS, len(lost), text),)


def _sensors_disagree(raw: RawModel, rigs: Sequence[RawRig], frames: Sequence[RawFrame]) -> tuple[Finding, ...]:
    """Compare what rigs, frames, cameras and images say of each other; COLMAP refuses a model where they disagree.

    The camera of an image is the one that the images file names; what keeps an image from being placed is another
    finding, see `_not_placed`.
    """
    known = set(raw.cameras.camera_id.tolist())
    sensors_of = {rig.rig_id: rig.sensor_from_rig for rig in rigs}
    camera_of = dict(zip(raw.images.image_id.tolist(), raw.images.camera_id.tolist(), strict=True))
    problems = [
        f"rig {rig.rig_id} has camera {sensor_id}, which does not exist"
        for rig in rigs
        for kind, sensor_id in rig.sensor_from_rig
        if kind == CAMERA_SENSOR and sensor_id not in known
    ]
    for frame in frames:
        sensors = sensors_of.get(frame.rig_id)
        if sensors is None:
            if camera_of.keys() & set(frame.image_ids):
                continue  # its images are not placed, which is said already
            problems.append(f"frame {frame.frame_id} is of rig {frame.rig_id}, which does not exist")
            continue
        for image_id, sensor_id in zip(frame.image_ids, frame.sensor_ids, strict=True):
            camera_id = camera_of.get(image_id, sensor_id)
            if camera_of.get(image_id) == sensor_id:
                continue  # they agree; whether the rig has it is said already
            if (CAMERA_SENSOR, sensor_id) not in sensors:
                where = f"frame {frame.frame_id} has image {image_id} of camera {sensor_id}"
                problems.append(f"{where}, which is not in rig {frame.rig_id}")
            elif camera_id != sensor_id:
                where = f"frame {frame.frame_id} has image {image_id} as of camera {sensor_id}"
                problems.append(f"{where}, the images file as of camera {camera_id}")
    if not problems:
        return ()
    more = f", and {len(problems) - 1} more" if len(problems) > 1 else ""
    text = f"rigs, frames, cameras and images disagree about their sensors: {problems[0]}{more}"
    return (Finding(FindingCode.SENSORS_DISAGREE, len(problems), text),)


def _one_file_missing(rigs: Sequence[RawRig] | None, frames: Sequence[RawFrame] | None) -> tuple[Finding, ...]:
    if rigs is None and frames is None:
        return ()
    there, missing = ("frames", "rigs") if rigs is None else ("rigs", "frames")
    text = f"there is a {there} file and no {missing} file, so all poses are those of the images file"
    return (Finding(FindingCode.INCOMPLETE_RIGS, 1, text),)
