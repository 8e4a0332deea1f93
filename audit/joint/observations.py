"""The observations that enter the joint system, with their Jacobians and weights (method.md section 11)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.projected import ImageInliers, image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.design import AT_ONCE, EVERY, PART, POINT, Design, make_design
from sfm_audit.audit.joint.layout import NUM_POSE, Layout, make_layout
from sfm_audit.audit.kernels import joint_parts as kernels
from sfm_audit.audit.kernels.joint import JointIndex
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

MIN_INLIERS: Final = 20
_HUBER: Final = 2.5  # sigma from which on an observation loses weight
_SINGULAR_POINT: Final = 1e-9  # determinant of V with unit diagonal
_SMALLEST_SQUARE: Final = 1e-300
_MIN_VIEWS: Final = 2


@dataclass(frozen=True, eq=False)
class JointObservations:
    """The n observations of the system by image; C = ``layout.width``.

    Points are numbered in the order in which images first see them, and an image's observations follow that order:
    whoever goes through an image finds what it needs nearly in one piece.

    model, residuals: where they come from.
    offsets: (I + 1,) image i owns rows offsets[i]:offsets[i + 1].    source: (n,) columns of ModelResiduals.
    image_idx: (n,).    points: (P,) rows of PointTable.    point_idx: (n,) places in ``points``; independent points
    have one for each observation.
    design: (n, 2, C) see `Design`.
    transform: (I, C, C) T of each image: N = design T. A translation in the camera's axes moves a pixel as one in the
    world's axes moves it, turned, so that nothing is stored twice.
    weight: (n,) w / s^2 with w = min(1, 2.5 s / |eps|), 1 / px^2.
    sigma_px: (I,) s.    rms_px: (I,) of all inliers.
    by_point: (n,) rows by point, then in order; point_offsets: (P + 1,) point p owns by_point[o[p]:o[p + 1]].
    points_independent: whether points are known from elsewhere, so that nothing is eliminated.
    """

    model: SparseModel
    residuals: ModelResiduals
    layout: Layout
    offsets: IntArray
    source: IntArray
    image_idx: Int32Array
    points: IntArray
    point_idx: Int32Array
    design: Design
    transform: FloatArray
    weight: FloatArray
    sigma_px: FloatArray
    rms_px: FloatArray
    by_point: Int32Array
    point_offsets: IntArray
    points_independent: bool

    @cached_property
    def index(self) -> JointIndex:
        """Who sees what, as compiled sums take it: checked once."""
        return JointIndex(self.offsets, self.image_idx, self.point_idx, self.by_point, self.point_offsets)

    @property
    def num_points(self) -> int:
        """P: rows of per-point arrays."""
        return len(self.point_offsets) - 1

    @property
    def used_images(self) -> list[int]:
        """Images with columns and observations."""
        return np.flatnonzero(self.layout.has_columns & (np.diff(self.offsets) > 0)).tolist()

    def rows(self, image_idx: int) -> slice:
        """Observations of an image."""
        return slice(int(self.offsets[image_idx]), int(self.offsets[image_idx + 1]))

    def num_of(self, image_idx: int) -> int:
        """How many observations an image has."""
        return int(self.offsets[image_idx + 1] - self.offsets[image_idx])

    def residuals_px(self) -> FloatArray:
        """(n, 2) observed minus projected."""
        out = np.empty((self.source.size, 2))
        for axis, of_all in enumerate(self.residuals.residuals_px):
            out[:, axis] = of_all.take(self.source)
        return out

    def parts(self, image_idx: int) -> list[slice]:
        """Observations of an image whose derivatives are in memory at the same time: all, or those of a part."""
        num = self.num_of(image_idx)
        return [slice(start, min(start + PART, num)) for start in range(0, num, PART)] if num > AT_ONCE else [EVERY]

    def jacobian(self, image_idx: int, chosen: slice | IntArray = EVERY) -> FloatArray:
        """J (n_i, 2, 3) of an image, or of some of its observations, px per model unit, world frame."""
        return self.design.jacobian(image_idx, chosen)

    def nuisance(self, image_idx: int, chosen: slice | IntArray = EVERY) -> FloatArray:
        """N (n_i, 2, C) of an image, or of some of its observations, px per unit of its columns."""
        return np.asarray(self.design.of(image_idx, chosen) @ self.transform[image_idx])

    def subtract_step(self, left_px: FloatArray, image_idx: int, step: FloatArray) -> None:
        """Subtract N step of an image, ``step`` (C,), from its rows of ``left_px`` (n, 2), in place."""
        own = left_px[self.rows(image_idx)]
        for part in self.parts(image_idx):
            own[part] -= self.nuisance(image_idx, part) @ step

    def weighted(self, views: IntArray | slice) -> tuple[FloatArray, FloatArray]:
        """Return (v, 2, C) the design of some observations, and (v,) their weights."""
        return self.design.at(views), self.weight[views]

    def scores(self, views: IntArray | slice, left_px: FloatArray) -> FloatArray:
        """(v, C) w design^T y~ of some observations; ``left_px`` (n, 2) is y~ of all."""
        design, weight = self.weighted(views)
        return design_scores(design, weight, left_px[views])

    @property
    def plain_weight(self) -> FloatArray:
        """(n,) 1 / s^2, 1 / px^2; where nothing loses weight to the last bit the same as ``weight``."""
        return np.asarray(1.0 / np.repeat(self.sigma_px, np.diff(self.offsets)) ** 2)

    def inliers(self, image_idx: int, chosen: slice | IntArray = EVERY) -> ImageInliers:
        """The observations of an image that are in the system, or some of them."""
        source = self.source[self.rows(image_idx)][chosen] - self.residuals.offsets[image_idx]
        return image_inliers(self.model, self.residuals, image_idx, source)


def usable_images(model: SparseModel, residuals: ModelResiduals, sigma_px: FloatArray) -> BoolArray:
    """(I,) images with a camera, 20 inliers or more, and known noise (``sigma_px`` (I,)): others have no columns."""
    known = np.isfinite(sigma_px) & (sigma_px > 0)
    return np.asarray((np.diff(residuals.offsets) >= MIN_INLIERS) & known & (model.images.camera_idx >= 0))


def joint_observations(
    model: SparseModel,
    residuals: ModelResiduals,
    sigma_px: FloatArray,
    *,
    left_out: BoolArray | None = None,
    frame_idx: IntArray | None = None,
    image_from_frame: FloatArray | None = None,
    points_independent: bool = False,
) -> JointObservations:
    """Choose the observations and differentiate them.

    Images with fewer than 20 inliers, unknown or zero noise, or derivatives that are not finite have no columns, and
    their observations are left out of everything; so are those of ``left_out`` (I,). Points with fewer than two
    views left or with a singular V (two rays that are parallel) are left out with their observations.
    """
    used = usable_images(model, residuals, sigma_px) & (True if left_out is None else ~left_out)
    candidates = _Candidates.of(residuals, used)
    used[candidates.images_not_finite()] = False
    weight, rms_px = candidates.weights(sigma_px)
    in_use = used[candidates.image_idx]
    if not points_independent:
        some = weight if in_use.all() else np.where(in_use, weight, 0.0)
        in_use &= candidates.have_regular_points(some, len(model.points))
    layout = make_layout(model, used, frame_idx, image_from_frame)
    rows, image_idx, seen = candidates.chosen(in_use)
    weight = weight[in_use] if len(weight) > len(seen) else weight
    offsets = np.searchsorted(image_idx, np.arange(len(model.images) + 1)).astype(np.int64)
    sight = (
        _each_by_itself(seen) if points_independent else _in_order_of_sight(image_idx, seen, offsets, len(model.points))
    )
    source = sight.order if rows is None else rows[sight.order]
    return JointObservations(
        model,
        residuals,
        layout,
        offsets,
        source,
        image_idx,
        sight.points,
        sight.point_idx,
        make_design(model, residuals, layout, source, offsets),
        _transforms(model, layout),
        weight[sight.order],
        sigma_px,
        rms_px,
        sight.by_point,
        sight.point_offsets,
        points_independent,
    )


def _each_by_itself(point_idx: Int32Array) -> kernels.Sight:
    """Observations of independent points."""
    order = np.arange(point_idx.size)
    rows = order.astype(np.int32)
    return kernels.Sight(point_idx.astype(np.int64), order, rows, rows, np.arange(point_idx.size + 1))


def _in_order_of_sight(
    image_idx: Int32Array, point_idx: Int32Array, offsets: IntArray, num_points: int
) -> kernels.Sight:
    compiled = kernels.in_order_of_sight(image_idx, point_idx, offsets, num_points)
    if compiled is not None:
        return compiled
    seen, first = np.unique(point_idx, return_index=True)
    points = seen[np.argsort(first)].astype(np.int64)
    number = np.zeros(num_points, dtype=np.int32)
    number[points] = np.arange(points.size)
    order = np.lexsort((number[point_idx], image_idx))
    place = number[point_idx[order]]
    starts = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=points.size))]).astype(np.int64)
    return kernels.Sight(points, order, place, np.argsort(place, kind="stable").astype(np.int32), starts)


def _transforms(model: SparseModel, layout: Layout) -> FloatArray:
    """(I, C, C) T: d / d translation of the camera = J R^-1, then from the frame's pose to the image's."""
    out = np.tile(np.eye(layout.width), (len(model.images), 1, 1))
    images = np.flatnonzero(layout.has_columns)
    out[images, POINT, POINT] = np.linalg.pinv(rotation_from_quat(model.images.quat_cam_from_world_wxyz[images]))
    out[:, :NUM_POSE, :NUM_POSE] = out[:, :NUM_POSE, :NUM_POSE] @ layout.image_from_frame
    return out


def design_crossed(design: FloatArray, weight: FloatArray) -> FloatArray:
    """(v, 3, C) w J^T design of observations: times T what (6) sums to W^T."""
    weighted = design[:, :, POINT] * weight[:, None, None]
    return np.asarray(np.matmul(weighted.transpose(0, 2, 1), design))


def design_scores(design: FloatArray, weight: FloatArray, left_px: FloatArray) -> FloatArray:
    """(v, C) w design^T y~ of observations with the residuals y~ (v, 2)."""
    return np.asarray(np.einsum("nac,na->nc", design, left_px * weight[:, None]))


class _Candidates(NamedTuple):
    """Inliers of the images that may take part: of a block of a large model a small part.

    rows: (n,) columns of ModelResiduals, None for all.    image_idx, point_idx: (n,) rows of their tables.
    jacobian: (2, 3, n).    residuals_px: (2, n).    counts: (I,) of each image.
    """

    rows: IntArray | None
    image_idx: Int32Array
    point_idx: Int32Array
    jacobian: FloatArray
    residuals_px: FloatArray
    counts: IntArray

    @classmethod
    def of(cls, residuals: ModelResiduals, used: BoolArray) -> _Candidates:
        counts = np.diff(residuals.offsets)
        image_idx = np.repeat(np.arange(counts.size, dtype=np.int32), counts)
        point_idx = residuals.point_idx.astype(np.int32, copy=False)
        jacobian, residuals_px = residuals.point_jacobian, residuals.residuals_px
        if used[counts > 0].all():
            return cls(None, image_idx, point_idx, jacobian, residuals_px, counts)
        rows = np.flatnonzero(np.repeat(used, counts))
        of_rows = image_idx[rows], point_idx[rows], jacobian[:, :, rows], residuals_px[:, rows]
        return cls(rows, *of_rows, np.where(used, counts, 0))

    def chosen(self, in_use: BoolArray) -> tuple[IntArray | None, Int32Array, Int32Array]:
        """Return rows, image_idx and point_idx of those in use (n,)."""
        if in_use.all():
            return self.rows, self.image_idx, self.point_idx
        rows = np.flatnonzero(in_use) if self.rows is None else self.rows[in_use]
        return rows, self.image_idx[in_use], self.point_idx[in_use]

    def images_not_finite(self) -> Int32Array:
        """Return the images of derivatives that are not finite, each as often as it has some."""
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(self.jacobian.sum()):
                return self.image_idx[:0]
            return np.asarray(self.image_idx[~np.isfinite(self.jacobian.sum(axis=(0, 1)))])

    def weights(self, sigma_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (n,) w / s^2, and (I,) the root mean square length of all residuals, NaN without any."""
        out, total = np.empty(self.image_idx.size), np.zeros(self.counts.size)
        ends = np.concatenate([[0], np.cumsum(self.counts)])

        def fill(start: int, stop: int) -> None:
            rows, counts = slice(int(ends[start]), int(ends[stop])), self.counts[start:stop]
            square = (self.residuals_px[:, rows] ** 2).sum(axis=0)
            # by image: differences of a running sum lose what is small
            total[start:stop] = np.bincount(np.repeat(np.arange(stop - start), counts), square, stop - start)
            sigma = np.repeat(sigma_px[start:stop], counts)
            with np.errstate(divide="ignore", invalid="ignore"):
                robust = np.minimum(1.0, _HUBER * sigma / np.sqrt(square))
            robust[square == 0] = 1.0
            out[rows] = robust / sigma**2

        over_ranges(fill, self.counts.size, self.counts)
        with np.errstate(invalid="ignore", divide="ignore"):
            return out, np.asarray(np.sqrt(total / self.counts))

    def have_regular_points(self, weight: FloatArray, num_points: int) -> BoolArray:
        """(n,) whether the point has two views or more, and a V that can be inverted."""
        seen = np.zeros(num_points, dtype=bool)
        seen[self.point_idx] = True
        num_seen = int(np.count_nonzero(seen))
        point_idx = self.point_idx if num_seen == num_points else (np.cumsum(seen) - 1)[self.point_idx]
        information, views = point_information(self.jacobian, weight, point_idx, num_seen)
        determinants = kernels.unit_determinants(information, smallest=_SMALLEST_SQUARE, invert=False)
        if determinants is None:
            scale = np.sqrt(np.maximum(np.einsum("pii->pi", information), _SMALLEST_SQUARE))
            determinants = np.linalg.det(information / scale[:, :, None] / scale[:, None, :])
        return np.asarray(((views >= _MIN_VIEWS) & (determinants > _SINGULAR_POINT))[point_idx])


def point_information(
    jacobian: FloatArray, weight: FloatArray, point_idx: Int32Array | IntArray, num_points: int
) -> tuple[FloatArray, IntArray]:
    """Return V (P, 3, 3) of (6): sum of w J^T J over a point's views, of J (2, 3, n); and (P,) views with w > 0."""
    compiled = kernels.point_information(jacobian, weight, point_idx, num_points)
    if compiled is not None:
        return compiled
    out = np.empty((num_points, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = (jacobian[0, i] * jacobian[0, j] + jacobian[1, i] * jacobian[1, j]) * weight
            product[weight == 0] = 0.0
            out[:, i, j] = out[:, j, i] = np.bincount(point_idx, product, num_points)
    return out, np.bincount(point_idx[weight > 0], minlength=num_points)
