"""Images that one pose of their rig places: what moving it does to each of them (method.md section 11)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.inliers.stationarity import offset_px, offsets_of_sums, pose_columns
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, IntArray, distinct
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

_NUM_POSE = 6


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Which images move together: frame_idx (I,), and image_from_frame (I, 6, 6) of each, see there."""

    frame_idx: IntArray
    image_from_frame: FloatArray


def claimed_frames(model: SparseModel) -> Frames | None:
    """Return the frames that the model claims; None where every image has a pose of its own."""
    frame_idx, poses = model.images.frame_idx, model.images.pose_cam_from_rig
    if frame_idx is None or poses is None:
        return None
    with np.errstate(all="ignore"):  # a pose that is not finite: its image has no inliers
        rotations = rotation_from_quat(poses[:, :4])
        transforms = [image_from_frame(rotation, pose[4:]) for rotation, pose in zip(rotations, poses, strict=True)]
    return Frames(frame_idx, np.array(transforms))


def image_from_frame(rotation_sensor_from_rig: FloatArray, translation_sensor_from_rig: FloatArray) -> FloatArray:
    """Return (6, 6): what moving a frame does to the pose of one of its images.

    Notes
    -----
    Left perturbations: Xc' = Xc + w x Xc + t. With Xc = R_s Xr + t_s: w_c = R_s w, t_c = R_s t + t_s x (R_s w).
    """
    out = np.zeros((_NUM_POSE, _NUM_POSE))
    out[:3, :3] = out[3:, 3:] = rotation_sensor_from_rig
    out[3:, :3] = cross_matrix(translation_sensor_from_rig) @ rotation_sensor_from_rig
    return out


def cross_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) matrix [v] with [v] a = v x a."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def frame_offsets_px(
    model: SparseModel,
    frames: Frames,
    offsets: IntArray,
    point_idx: IndexArray,
    on_points: tuple[FloatArray, FloatArray],
    *,
    sums: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Return (I,) pose_offset_px of the frame that each image belongs to, NaN without inliers in the frame.

    Parameters
    ----------
    offsets, point_idx : as in ModelResiduals
    on_points : residuals (2, n) and their Jacobians (2, 3, n) in the world frame
    sums : of each image's own pose, (I, 6, 6) and (I, 6) as `stationarity.offsets_of_sums` has them, where at hand
    """
    out, asked = np.full(len(model.images), np.nan), distinct(frames.frame_idx)
    if sums is not None and len(out):
        out, is_sure = _offsets_of_sums(frames, sums, np.diff(offsets))
        asked = distinct(frames.frame_idx[~is_sure])
    residuals, jacobian = on_points
    for frame in asked.tolist():
        members = np.flatnonzero(frames.frame_idx == frame)
        columns, own = [np.empty((_NUM_POSE, 2, 0))], [np.empty((2, 0))]
        for image_idx in members.tolist():
            rows = slice(int(offsets[image_idx]), int(offsets[image_idx + 1]))
            if rows.start == rows.stop:
                continue
            image = model.image(image_idx)
            xyz_cam = image.cam_from_world(model.points.xyz_world.take(point_idx[rows], axis=0))
            in_camera = np.linalg.pinv(image.rotation_cam_from_world.T) @ jacobian[:, :, rows]
            pose = pose_columns(in_camera, xyz_cam)
            columns.append(np.einsum("akn,ab->bkn", pose, frames.image_from_frame[image_idx]))
            own.append(residuals[:, rows])
        out[members] = offset_px(np.concatenate(columns, axis=2), np.concatenate(own, axis=1))
    return out


def _offsets_of_sums(
    frames: Frames, sums: tuple[FloatArray, FloatArray], num_points: IntArray
) -> tuple[FloatArray, BoolArray]:
    """By image: the offset of its frame, and whether it is well above rounding.

    The columns of a frame's pose are those of its images times `image_from_frame`, and their products add up.
    """
    order = np.argsort(frames.frame_idx, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(frames.frame_idx[order]) != 0))
    is_seen = (num_points > 0)[order, None, None]
    image_from_frame = np.where(is_seen, frames.image_from_frame[order], 0.0)  # of no inliers: a pose may be no number
    transposed = image_from_frame.swapaxes(1, 2)
    gram = np.add.reduceat(transposed @ sums[0][order] @ image_from_frame, starts, axis=0)
    right = np.add.reduceat((transposed @ sums[1][order][:, :, None])[:, :, 0], starts, axis=0)
    num = np.add.reduceat(num_points[order], starts)
    offsets, is_sure = offsets_of_sums(gram, right, num)
    sizes = np.diff(np.append(starts, len(order)))
    out, sure = np.full(len(order), np.nan), np.zeros(len(order), dtype=np.bool_)
    out[order], sure[order] = np.where(num > 0, offsets, np.nan).repeat(sizes), (is_sure | (num == 0)).repeat(sizes)
    return out, sure
