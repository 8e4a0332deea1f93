"""Which images should see a point, because they stand close to one that does? Geometry of the model alone.

Image j should see a point if the point lies before it and inside its photo, and an image that sees the point stands
within 12 degrees of j, as the point sees them, at a distance within a factor of 1.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy import sparse

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels import witnesses as kernels
from sfm_audit.audit.witnesses.covisibility import SeenBy, covisibility
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

MAX_ANGLE_DEG: Final = 12.0
MAX_DISTANCE_RATIO: Final = 1.4
MIN_TRACK: Final = 3
MAX_POINTS: Final = 20_000
"""Points that are asked; of more, a random part with a fixed seed."""
_MIN_COSINE: Final = float(np.cos(np.radians(MAX_ANGLE_DEG)))
_MARGIN: Final = 0.49  # of the image's size, from its middle, without distortion
_REACH: Final = 0.471
"""Over an image's distance from a point: how far off another can stand that should see the point; law of cosines."""


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


def should_see(
    model: SparseModel, residuals: ModelResiduals, *, seed: int = 0, seen_by: SeenBy | None = None
) -> ShouldSee:
    """Ask of points that three images and more see who else should.

    Parameters
    ----------
    seed : of the points that are asked        seen_by : where it is at hand
    """
    views = _Views.of(model)
    seen = _Seen.of(model, seen_by or covisibility(residuals, len(model.points))[0], views, seed)
    found = kernels.should_see(
        (seen.xyz, seen.offsets, seen.image, seen.ray, seen.distance),
        (views.rotation, views.centre, views.share, views.size, views.usable),
        (_REACH, MAX_DISTANCE_RATIO, _MIN_COSINE),
    )
    sizes = seen.xyz.shape[1], len(model.images)
    if found is not None:
        return ShouldSee(sizes[0], sizes[1], *found)
    by_image = _ByImage.of(seen, len(model.images))
    parts = [_of_image(seen, by_image, views, j) for j in np.flatnonzero(views.usable).tolist()]
    point, image, sees, ray, distance = (
        np.concatenate([empty, *(part[k] for part in parts)], axis=-1) for k, empty in enumerate(_EMPTY)
    )
    return ShouldSee(*sizes, point, image, sees, ray, distance)


_ALL: Final = 0.5
"""Observations of images close by, over points, from which all points are asked: numpy finds no sooner which."""
_EMPTY: Final = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.bool_), np.empty((3, 0)), np.empty(0))


@dataclass(frozen=True, eq=False)
class _Seen:
    """The points asked, and who sees them.

    xyz: (3, p).    offsets: (p + 1,) observations by point; image (n,), ray (3, n), distance (n,): of each.
    """

    xyz: FloatArray
    offsets: IntArray
    image: IntArray
    ray: FloatArray
    distance: FloatArray

    @cached_property
    def point(self) -> IntArray:
        """(n,) of each observation."""
        return np.repeat(np.arange(self.xyz.shape[1]), np.diff(self.offsets))

    @classmethod
    def of(cls, model: SparseModel, seen_by: SeenBy, views: _Views, seed: int) -> _Seen:
        """Choose the points."""
        kept = views.usable[seen_by.image_idx]
        all_kept = bool(kept.all())
        ends = seen_by.offsets if all_kept else np.concatenate([[0], np.cumsum(kept)])[seen_by.offsets]
        image_idx = seen_by.image_idx if all_kept else seen_by.image_idx[kept]
        chosen = np.flatnonzero((np.diff(ends) >= MIN_TRACK) & np.isfinite(model.points.xyz_world).all(axis=1))
        if len(chosen) > MAX_POINTS:
            chosen = np.sort(np.random.default_rng(seed).choice(chosen, MAX_POINTS, replace=False))
        first, length = ends[chosen], ends[chosen + 1] - ends[chosen]
        offsets: IntArray = np.concatenate([[0], np.cumsum(length)])
        image = image_idx[np.repeat(first - offsets[:-1], length) + np.arange(offsets[-1])].astype(np.int64)
        xyz = np.ascontiguousarray(model.points.xyz_world[chosen].T)
        ray, distance = _rays(views.centre[image].T - np.repeat(xyz, length, axis=1))
        return cls(xyz, offsets, image, ray, distance)


@dataclass(frozen=True, slots=True, eq=False)
class _ByImage:
    """The observations of `_Seen` by image, (n,), those of an image at offsets (I + 1,); farthest (I,) distance."""

    row: IntArray
    offsets: IntArray
    farthest: FloatArray

    @classmethod
    def of(cls, seen: _Seen, num_images: int) -> _ByImage:
        """Sort."""
        row = np.argsort(seen.image, kind="stable")
        offsets: IntArray = np.concatenate([[0], np.cumsum(np.bincount(seen.image, minlength=num_images))])
        farthest = np.zeros(num_images)
        np.maximum.at(farthest, seen.image, seen.distance)
        return cls(row, offsets, farthest)


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Poses and fields of view of all images.

    rotation: (I, 3, 3) camera from world.    centre: (I, 3).    size: (I, 2) px.    share: (I,) 1 / px, of the depth.
    usable: (I,) which have a pose and a camera with a focal length.
    """

    rotation: FloatArray
    centre: FloatArray
    size: FloatArray
    share: FloatArray
    usable: BoolArray

    @classmethod
    def of(cls, model: SparseModel) -> _Views:
        """Collect them."""
        images, cameras = model.images, model.cameras
        rotation = rotation_from_quat(images.quat_cam_from_world_wxyz)
        centre = np.ascontiguousarray(-np.einsum("nij,ni->nj", rotation, images.translation_cam_from_world))
        focal = np.full(len(cameras) + 1, np.nan)  # the last is that of images without a camera
        for model_id in distinct(cameras.model_id).tolist():
            alike = np.flatnonzero(cameras.model_id == model_id)
            idxs = BY_ID[int(model_id)].focal_idxs
            if idxs:
                focal[alike] = cameras.params[cameras.param_offsets[alike][:, None] + np.array(idxs)].mean(axis=1)
        size = np.column_stack([cameras.width, cameras.height]).astype(np.float64)
        has_focal = np.array([bool(BY_ID[int(each)].focal_idxs) for each in cameras.model_id.tolist()] + [False])
        usable = np.isfinite(centre).all(axis=1) & has_focal[images.camera_idx]
        with np.errstate(all="ignore"):
            share = _MARGIN / focal[images.camera_idx]
        return cls(rotation, centre, np.concatenate([size, [[0.0, 0.0]]])[images.camera_idx], share, usable)


def _rays(from_point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return directions (3, n) and lengths (n,) of (3, n)."""
    x, y, z = from_point
    distance = np.sqrt(x * x + y * y + z * z)
    return from_point / np.maximum(distance, np.finfo(float).tiny), distance


def _of_image(
    seen: _Seen, by_image: _ByImage, views: _Views, image_idx: int
) -> tuple[IntArray, IntArray, BoolArray, FloatArray, FloatArray]:
    """Return the points that one image should see: the columns of `ShouldSee`."""
    near = _near(seen, by_image, views, image_idx)
    from_image = (seen.xyz if near is None else seen.xyz.take(near, axis=1)) - views.centre[image_idx][:, None]
    x, y, depth = views.rotation[image_idx] @ from_image
    limit, (width, height) = depth * views.share[image_idx], views.size[image_idx]
    inside = np.flatnonzero((np.abs(x) < limit * width) & (np.abs(y) < limit * height) & (depth > 0))
    point, from_image = inside if near is None else near[inside], from_image.take(inside, axis=1)
    ray, distance = _rays(-from_image)
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


def _near(seen: _Seen, by_image: _ByImage, views: _Views, image_idx: int) -> IntArray | None:
    """Return the points that an image sees which stands so close that both may should see them; None: ask all."""
    apart = np.sqrt(((views.centre - views.centre[image_idx]) ** 2).sum(axis=1)) / _REACH
    others = np.flatnonzero(apart <= by_image.farthest)
    first, length = by_image.offsets[others], by_image.offsets[others + 1] - by_image.offsets[others]
    ends = np.cumsum(length)
    if not len(ends) or ends[-1] > _ALL * seen.xyz.shape[1]:
        return None
    row = by_image.row[np.repeat(first - ends + length, length) + np.arange(ends[-1])]
    close = row[seen.distance[row] >= np.repeat(apart[others], length)]
    is_near = np.zeros(seen.xyz.shape[1], dtype=np.bool_)
    is_near[seen.point[close]] = True
    return np.flatnonzero(is_near)
