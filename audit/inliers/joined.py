"""Inliers of several images of one camera, as if they were one image: numpy's overhead is paid once, not per image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, moved, rotation_from_quat

MAX_JOINED: Final = 64
"""Of an image with more inliers the values cost more than the calls, and few have the same number."""


def joined_inliers(
    model: SparseModel, residuals: ModelResiduals, image_idxs: Sequence[int], num_each: int
) -> ImageInliers:
    """Return the inliers of B images of one camera, each of which has ``num_each`` > 0, one image after the other.

    The camera predicts each point by itself, so that what it predicts is that of the single images. ``image`` is the
    first of them and stands for none.
    """
    images: IntArray = np.array(image_idxs, dtype=np.int64)
    columns = (residuals.offsets[images][:, None] + np.arange(num_each)).ravel()
    xyz_world = model.points.xyz_world.take(residuals.point_idx[columns], axis=0)
    quats, translations = model.images.quat_cam_from_world_wxyz[images], model.images.translation_cam_from_world[images]
    image = model.image(int(images[0]))
    if image.camera is None:
        raise ValueError(f"image {image.image_id} has no camera")
    return ImageInliers(
        image,
        image.camera,
        model.observations.xy_px.take(residuals.observation_row[columns], axis=0),
        xyz_world,
        residuals.residuals_px[:, columns],
        np.asfortranarray(moved(quats.repeat(num_each, 0).T, translations.repeat(num_each, 0).T, xyz_world)),
        _in_camera(quats, residuals.point_jacobian[:, :, columns]),
        np.concatenate(residuals.d_extra.of(image_idxs), axis=2),
    )


def _in_camera(quats: FloatArray, point_jacobian: FloatArray) -> FloatArray:
    """Turn (2, 3, B * n) from the world into the frames of cameras with these quaternions (B, 4)."""
    cam_from_gradient = np.linalg.pinv(rotation_from_quat(quats).swapaxes(1, 2))[:, None]
    by_image = point_jacobian.reshape(2, 3, len(quats), -1).transpose(2, 0, 1, 3)
    return np.ascontiguousarray((cam_from_gradient @ by_image).transpose(1, 2, 0, 3)).reshape(point_jacobian.shape)


def by_image(columns: FloatArray, num_images: int) -> FloatArray:
    """Return (B, c, 2, n) of columns (c, 2, B n) of joined inliers."""
    num_points = columns.shape[2] // num_images  # of no columns too
    by_column = columns.reshape(len(columns), 2, num_images, num_points)
    return np.ascontiguousarray(by_column.transpose(2, 0, 1, 3))


def flat(columns: FloatArray) -> FloatArray:
    """Return (B, c, 2 n) of (B, c, 2, n)."""
    return columns.reshape(*columns.shape[:2], 2 * columns.shape[3])
