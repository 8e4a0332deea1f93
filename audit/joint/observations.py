"""The observations that enter the joint system, with their Jacobians and weights (method.md section 11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.projected import ImageInliers, image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.design import AT_ONCE, EVERY, PART, POINT, Design, make_design
from sfm_audit.audit.joint.layout import NUM_POSE, Layout, make_layout
from sfm_audit.audit.kernels import joint_parts as kernels
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

MIN_INLIERS: Final = 20
_HUBER: Final = 2.5  # sigma from which on an observation loses weight
_SINGULAR_POINT: Final = 1e-9  # determinant of V with unit diagonal
_SMALLEST_SQUARE: Final = 1e-300
_MIN_VIEWS: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
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
    image_idx: IntArray
    points: IntArray
    point_idx: IntArray
    design: Design
    transform: FloatArray
    weight: FloatArray
    sigma_px: FloatArray
    rms_px: FloatArray
    by_point: IntArray
    point_offsets: IntArray
    points_independent: bool

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
        return np.ascontiguousarray(self.residuals.residuals_px.take(self.source, axis=1).T)

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
    used = usable_images(model, residuals, sigma_px)
    used &= ~left_out if left_out is not None else True
    candidates = _Candidates.of(residuals, used)
    used[candidates.image_idx[~np.isfinite(candidates.jacobian.sum(axis=(0, 1)))]] = False
    weight = candidates.weights(sigma_px)
    in_use = used[candidates.image_idx]
    if not points_independent:
        in_use &= candidates.have_regular_points(np.where(in_use, weight, 0.0), len(model.points))
    layout = make_layout(model, used, frame_idx, image_from_frame)
    image_idx, seen = candidates.image_idx[in_use], candidates.point_idx[in_use]
    num_images = len(model.images)
    offsets = np.searchsorted(image_idx, np.arange(num_images + 1)).astype(np.int64)
    sight = (
        _each_by_itself(seen) if points_independent else _in_order_of_sight(image_idx, seen, offsets, len(model.points))
    )
    source = candidates.rows[in_use][sight.order]
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
        weight[in_use][sight.order],
        sigma_px,
        candidates.rms_px(num_images),
        sight.by_point,
        sight.point_offsets,
        points_independent,
    )


def _each_by_itself(point_idx: IntArray) -> kernels.Sight:
    """Observations of independent points."""
    rows = np.arange(point_idx.size)
    return kernels.Sight(point_idx, rows, rows, rows, np.arange(point_idx.size + 1))


def _in_order_of_sight(image_idx: IntArray, point_idx: IntArray, offsets: IntArray, num_points: int) -> kernels.Sight:
    compiled = kernels.in_order_of_sight(image_idx, point_idx, offsets, num_points)
    if compiled is not None:
        return compiled
    seen, first = np.unique(point_idx, return_index=True)
    points = seen[np.argsort(first)]
    number = np.zeros(num_points, dtype=np.int64)
    number[points] = np.arange(points.size)
    order = np.lexsort((number[point_idx], image_idx))
    place = number[point_idx[order]]
    starts = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=points.size))]).astype(np.int64)
    return kernels.Sight(points, order, place, np.argsort(place, kind="stable"), starts)


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

    rows: (n,) columns of ModelResiduals.    image_idx, point_idx: (n,) rows of their tables.    jacobian: (2, 3, n).
    sq_length_px2: (n,) of the residuals.
    """

    rows: IntArray
    image_idx: IntArray
    point_idx: IntArray
    jacobian: FloatArray
    sq_length_px2: FloatArray

    @classmethod
    def of(cls, residuals: ModelResiduals, used: BoolArray) -> _Candidates:
        counts = np.diff(residuals.offsets)
        rows = np.flatnonzero(np.repeat(used, counts))
        image_idx = np.repeat(np.flatnonzero(used), counts[used])
        jacobian, residuals_px, point_idx = residuals.point_jacobian, residuals.residuals_px, residuals.point_idx
        if rows.size < point_idx.size:
            jacobian, residuals_px, point_idx = jacobian[:, :, rows], residuals_px[:, rows], point_idx[rows]
        return cls(rows, image_idx, point_idx, jacobian, (residuals_px**2).sum(axis=0))

    def weights(self, sigma_px: FloatArray) -> FloatArray:
        """(n,) w / s^2."""
        sigma, length = sigma_px[self.image_idx], np.sqrt(self.sq_length_px2)
        with np.errstate(divide="ignore", invalid="ignore"):
            robust = np.minimum(1.0, _HUBER * sigma / length)
        robust[length == 0] = 1.0
        return np.asarray(robust / sigma**2)

    def rms_px(self, num_images: int) -> FloatArray:
        """(I,) root mean square length of all inliers' residuals, NaN without any."""
        # by image: differences of a running sum lose what is small
        total, counts = (np.bincount(self.image_idx, of, num_images) for of in (self.sq_length_px2, None))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt(total / counts))

    def have_regular_points(self, weight: FloatArray, num_points: int) -> BoolArray:
        """(n,) whether the point has two views or more, and a V that can be inverted."""
        seen = np.zeros(num_points, dtype=bool)
        seen[self.point_idx] = True
        num_seen = int(np.count_nonzero(seen))
        point_idx = self.point_idx if num_seen == num_points else (np.cumsum(seen) - 1)[self.point_idx]
        information = point_information(self.jacobian, weight, point_idx, num_seen)
        views = np.bincount(point_idx[weight > 0], minlength=num_seen)
        determinants = kernels.unit_determinants(information, smallest=_SMALLEST_SQUARE, invert=False)
        if determinants is None:
            scale = np.sqrt(np.maximum(np.einsum("pii->pi", information), _SMALLEST_SQUARE))
            determinants = np.linalg.det(information / scale[:, :, None] / scale[:, None, :])
        return np.asarray(((views >= _MIN_VIEWS) & (determinants > _SINGULAR_POINT))[point_idx])


def point_information(jacobian: FloatArray, weight: FloatArray, point_idx: IntArray, num_points: int) -> FloatArray:
    """Return V (P, 3, 3) of (6): sum of w J^T J over a point's views, of J (2, 3, n)."""
    compiled = kernels.point_information(jacobian, weight, point_idx, num_points)
    if compiled is not None:
        return compiled
    out = np.empty((num_points, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = (jacobian[0, i] * jacobian[0, j] + jacobian[1, i] * jacobian[1, j]) * weight
            product[weight == 0] = 0.0
            out[:, i, j] = out[:, j, i] = np.bincount(point_idx, product, num_points)
    return out
