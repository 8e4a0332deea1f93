"""Which images should see a point, because they stand close to one that does? Geometry of the model alone.

Image j should see a point if the point lies before it and inside its photo, and an image that sees the point stands
within 12 degrees of j, as the point sees them, at a distance within a factor of 1.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

MAX_ANGLE_DEG: Final = 12.0
MAX_DISTANCE_RATIO: Final = 1.4
MIN_TRACK: Final = 3
MAX_POINTS: Final = 20_000
"""Points that are asked; of more, a random part with a fixed seed."""
_MIN_COSINE: Final = float(np.cos(np.radians(MAX_ANGLE_DEG)))
_MARGIN: Final = 0.49  # of the image's size, from its middle, without distortion


@dataclass(frozen=True, slots=True, eq=False)
class ShouldSee:
    """Pairs of a point and an image that should see it.

    num_points, num_images: sizes.    point, image: (m,) the pairs.    sees: (m,) whether it does.
    ray: (3, m) unit vector from the point to the image.    distance: (m,) model units.
    """

    num_points: int
    num_images: int
    point: IntArray
    image: IntArray
    sees: BoolArray
    ray: FloatArray
    distance: FloatArray

    def matrix(self, values: FloatArray | BoolArray) -> sparse.csr_array:
        """Return values of the pairs as a sparse matrix (points, images)."""
        shape = self.num_points, self.num_images
        return sparse.csr_array((np.asarray(values, dtype=np.float64), (self.point, self.image)), shape=shape)


def should_see(model: SparseModel, residuals: ModelResiduals, *, seed: int = 0) -> ShouldSee:
    """Ask of points that three images and more see who else should."""
    seen = _Seen.of(model, residuals, seed)
    rotation, centre, usable = _poses(model)
    parts = [_of_image(seen, model, j, rotation[j], centre) for j in np.flatnonzero(usable).tolist()]
    point, image, sees, ray, distance = (
        np.concatenate([empty, *(part[k] for part in parts)], axis=-1) for k, empty in enumerate(_EMPTY)
    )
    return ShouldSee(seen.xyz.shape[1], len(model.images), point, image, sees, ray, distance)


_EMPTY: Final = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.bool_), np.empty((3, 0)), np.empty(0))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The points asked, and who sees them.

    xyz: (3, p).    offsets: (p + 1,) observations by point; image (n,), ray (3, n), distance (n,): of each.
    """

    xyz: FloatArray
    offsets: IntArray
    image: IntArray
    ray: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, model: SparseModel, residuals: ModelResiduals, seed: int) -> _Seen:
        """Choose the points; an image counts once, however often it observes a point."""
        num_images = len(model.images)
        image = np.repeat(np.arange(num_images), np.diff(residuals.offsets))
        _, centre, usable = _poses(model)
        keys = distinct(residuals.point_idx * num_images + image)
        keys = keys[usable[keys % num_images]] if num_images else keys
        length = np.bincount(keys // max(num_images, 1), minlength=len(model.points))
        chosen = np.flatnonzero((length >= MIN_TRACK) & np.isfinite(model.points.xyz_world).all(axis=1))
        if len(chosen) > MAX_POINTS:
            chosen = np.sort(np.random.default_rng(seed).choice(chosen, MAX_POINTS, replace=False))
        row = np.full(len(model.points), -1)
        row[chosen] = np.arange(len(chosen))
        keys = keys[row[keys // max(num_images, 1)] >= 0]
        point, image = row[keys // max(num_images, 1)], keys % max(num_images, 1)
        xyz = np.ascontiguousarray(model.points.xyz_world[chosen].T)
        ray, distance = _rays(centre[image].T - xyz[:, point])
        return cls(xyz, np.searchsorted(point, np.arange(len(chosen) + 1)), image, ray, distance)


def _poses(model: SparseModel) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return rotations (I, 3, 3), centres (I, 3), and which images have a pose and a camera with a focal length."""
    images = model.images
    rotation = rotation_from_quat(images.quat_cam_from_world_wxyz)
    centre = -np.einsum("nij,ni->nj", rotation, images.translation_cam_from_world)
    has_focal = np.array([bool(model.camera(k).model.focal_idxs) for k in range(len(model.cameras))] + [False])
    return rotation, centre, np.isfinite(centre).all(axis=1) & has_focal[images.camera_idx]


def _rays(from_point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return directions (3, n) and lengths (n,) of (3, n)."""
    x, y, z = from_point
    distance = np.sqrt(x * x + y * y + z * z)
    return from_point / np.maximum(distance, np.finfo(float).tiny), distance


def _of_image(
    seen: _Seen, model: SparseModel, image_idx: int, rotation: FloatArray, centre: FloatArray
) -> tuple[IntArray, IntArray, BoolArray, FloatArray, FloatArray]:
    """Return the points that one image should see: the columns of `ShouldSee`."""
    camera = model.camera(int(model.images.camera_idx[image_idx]))
    focal = float(np.mean([camera.params[k] for k in camera.model.focal_idxs]))
    from_image = seen.xyz - centre[image_idx][:, None]
    x, y, depth = rotation @ from_image
    limit = depth * (_MARGIN / focal)
    point = np.flatnonzero((np.abs(x) < limit * camera.width) & (np.abs(y) < limit * camera.height) & (depth > 0))
    ray, distance = _rays(-from_image.take(point, axis=1))
    count = seen.offsets[point + 1] - seen.offsets[point]
    which = np.repeat(np.arange(len(point)), count)
    starts = np.cumsum(count) - count
    row = np.arange(len(which)) - np.repeat(starts - seen.offsets[point], count)
    sees = np.zeros(len(point), dtype=np.bool_)
    sees[which[seen.image.take(row) == image_idx]] = True
    own, there = distance.take(which), seen.distance.take(row)
    asked = np.flatnonzero((own < MAX_DISTANCE_RATIO * there) & (own * MAX_DISTANCE_RATIO > there) & ~sees.take(which))
    which, row = which[asked], row[asked]
    cosine = np.zeros(len(which))
    for axis in range(3):
        cosine += seen.ray[axis].take(row) * ray[axis].take(which)
    should = sees.copy()
    should[which[cosine > _MIN_COSINE]] = True
    kept = np.flatnonzero(should)
    image = np.full(len(kept), image_idx)
    return point[kept], image, sees[kept], ray.take(kept, axis=1), distance[kept]
