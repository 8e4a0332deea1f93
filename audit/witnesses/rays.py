"""Where the 2D points of an image look, in the world frame, and how many pixels an angle is worth there."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from sfm_audit.audit.cameras import project_columns, unproject
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import PairSource, SparseModel, rotation_from_quat

Float32Array: TypeAlias = npt.NDArray[np.float32]
MAX_BYTES: Final = 400_000_000
"""Rays that are kept at a time; pairs come in the order of their first image, so few are made twice."""


def image_rays(model: SparseModel, image_idx: int, xy_px: FloatArray) -> Float32Array:
    """Return (n, 4): the unit ray of each 2D point in the world frame, and px per rad there; NaN without a ray.

    Notes
    -----
    The scale is the geometric mean over directions, (det J J^T)^(1/4) with J = d pixel / d ray: exact on the axis; a
    perspective camera sees radial displacements at the angle theta 1 / sqrt(cos theta) times larger, and tangential
    ones as much smaller.
    """
    image = model.image(image_idx)
    out = np.full((len(xy_px), 4), np.nan, dtype=np.float32)
    if image.camera is None:
        return out
    camera = image.camera
    with np.errstate(all="ignore"):
        rays_cam = unproject(camera.model, camera.params, xy_px)
        jacobian = project_columns(camera.model, camera.params, rays_cam).d_xy_d_cam
        (xx, xy), (_, yy) = np.einsum("ain,bin->abn", jacobian, jacobian)
        quat = image.quat_cam_from_world_wxyz
        world = rays_cam @ rotation_from_quat(quat / np.linalg.norm(quat))
        out[:, :3] = world
        out[:, 3] = np.maximum(xx * yy - xy * xy, 0.0) ** 0.25
    return out


def centres(model: SparseModel) -> FloatArray:
    """Return (I, 3) centres of all images in the world frame, model units."""
    images = model.images
    with np.errstate(all="ignore"):
        quat = images.quat_cam_from_world_wxyz
        rotation = rotation_from_quat(quat / np.linalg.norm(quat, axis=1, keepdims=True))
        return np.asarray(-np.einsum("nji,nj->ni", rotation, images.translation_cam_from_world))


class RayCache:
    """Rays of the images of a model, the least recently used forgotten."""

    def __init__(self, model: SparseModel, source: PairSource) -> None:
        self._model, self._source = model, source
        self._rays: OrderedDict[int, Float32Array] = OrderedDict()
        self._num_bytes = 0

    def rays(self, image_idx: int) -> Float32Array:
        """Return `image_rays` of all 2D points of an image."""
        if image_idx in self._rays:
            self._rays.move_to_end(image_idx)
            return self._rays[image_idx]
        rays = image_rays(self._model, image_idx, self._source.keypoints_px(image_idx))
        self._rays[image_idx] = rays
        self._num_bytes += rays.nbytes
        while self._num_bytes > MAX_BYTES and len(self._rays) > 2:
            self._num_bytes -= self._rays.popitem(last=False)[1].nbytes
        return rays
