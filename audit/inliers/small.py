"""Small images of one camera, projected as if they were one image: numpy's calls are paid once, not per image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import project_columns
from sfm_audit.audit.inliers.sanity import MAX_RESIDUAL_PX, are_differentiable, are_sane, is_usable
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, moved, rotation_from_quat

MAX_EACH: Final = 64
"""Of an image with more observations the values cost more than the calls."""
_MAX_TOGETHER: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class SmallImages:
    """Images all of whose n linked observations are inliers, one image after the other.

    images: (B,) rows of the image table.    offsets: (B + 1,) columns of each.    rows: (n,) of the observations.
    residuals_px: (2, n).    point_jacobian: (2, 3, n), world frame.    d_extra: (e, 2, n).
    pose_gram, pose_right: (B, 6, 6), (B, 6), see `stationarity.offsets_of_sums`.
    """

    images: IntArray
    offsets: IntArray
    rows: IntArray
    residuals_px: FloatArray
    point_jacobian: FloatArray
    d_extra: FloatArray
    pose_gram: FloatArray
    pose_right: FloatArray


def groups(model: SparseModel, images: IntArray) -> Iterator[IntArray]:
    """Yield rows of small images that have the same camera, two or more at a time, of these (m,) images."""
    num, camera_idx = np.diff(model.observations.offsets)[images], model.images.camera_idx[images]
    is_small = (num > 0) & (num <= MAX_EACH) & (camera_idx >= 0)
    images, num, camera_idx = images[is_small], num[is_small], camera_idx[is_small]
    order = np.argsort(camera_idx, kind="stable")
    images, num, camera_idx = images[order], num[order], camera_idx[order]
    part = (np.cumsum(num) - num) // _MAX_TOGETHER
    starts = np.flatnonzero((np.diff(camera_idx) != 0) | (np.diff(part) != 0)) + 1
    yield from (group for group in np.split(images, starts) if len(group) > 1)


def project_small(model: SparseModel, images: IntArray) -> SmallImages | None:
    """Project all linked observations of images of one camera; None where one of them is no inlier, or nearly none."""
    observations, table = model.observations, model.images
    camera = model.image(int(images[0])).camera
    num = np.diff(observations.offsets)[images]
    offsets = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(num)])
    rows = np.repeat(observations.offsets[images] - offsets[:-1], num) + np.arange(offsets[-1])
    point_idx, xy_px = observations.point_idx[rows], observations.xy_px[rows]
    if camera is None or camera.model.is_spherical or not is_usable(camera) or point_idx.min() < 0:
        return None
    quats, translations = table.quat_cam_from_world_wxyz[images], table.translation_cam_from_world[images]
    with np.errstate(all="ignore"):
        xyz_world = model.points.xyz_world[point_idx]
        xyz_cam = np.asfortranarray(moved(quats.repeat(num, 0).T, translations.repeat(num, 0).T, xyz_world))
        if not (are_sane(xyz_cam) and are_sane(xy_px) and xyz_cam[:, 2].min() > 0):
            return None
        extras = list(camera.model.extra_idxs)
        found = project_columns(camera.model, camera.params, xyz_cam, with_params=bool(extras))
        residuals = np.subtract(xy_px.T, found.xy_px, order="C")
        is_clear = np.abs(residuals).max() <= MAX_RESIDUAL_PX and are_differentiable(found.d_xy_d_cam, xyz_cam)
        if not is_clear:
            return None
        pose = pose_columns(found.d_xy_d_cam, xyz_cam)
        rotations = rotation_from_quat(quats).repeat(num, 0)
        d_extra = np.empty((0, 2, len(rows))) if found.d_xy_d_params is None else found.d_xy_d_params[extras]
        return SmallImages(
            images,
            offsets,
            rows,
            residuals,
            np.einsum("nbk,abn->akn", rotations, found.d_xy_d_cam),
            d_extra,
            np.add.reduceat(np.einsum("akn,bkn->nab", pose, pose), offsets[:-1], axis=0),
            np.add.reduceat(np.einsum("akn,kn->na", pose, residuals), offsets[:-1], axis=0),
        )
