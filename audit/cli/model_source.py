"""What the page wants of a model that lies where the run read it: where its cameras stand, and who sees what."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import sparse

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, rotation_from_quat
from sfm_audit.reports.charts.numbers import evenly
from sfm_audit.reports.charts.scene import SceneView

MAX_POINTS: Final = 1500  # drawn as a background
_MAX_PAIRS: Final = 20_000_000  # of observations of one point, counted for the images that share points


def scene_view(model: SparseModel) -> SceneView:
    """Return where the cameras of a model stand and which of its images share points."""
    images = model.images
    rotation = rotation_from_quat(images.quat_cam_from_world_wxyz)
    with np.errstate(all="ignore"):  # a pose that is not finite stands nowhere
        centre = -np.einsum("nji,nj->ni", rotation, images.translation_cam_from_world)
        ahead, up = (row / np.linalg.norm(row, axis=1, keepdims=True) for row in (rotation[:, 2], -rotation[:, 1]))
    points = model.points.xyz_world[np.isfinite(model.points.xyz_world).all(axis=1)]
    pairs, shared, share = covisibility(model)
    return SceneView(
        images.image_id.astype(np.int64),
        _finite_or_nan(centre),
        _finite_or_nan(ahead),
        _finite_or_nan(up),
        points[evenly(len(points), MAX_POINTS)],
        pairs,
        shared,
        share,
    )


def covisibility(model: SparseModel) -> tuple[IntArray, IntArray, float]:
    """Return pairs of images (m, 2) that share points, how many (m,), and the share of the points that was counted.

    A point seen by L images makes L^2 pairs: of models with more than 20 million, every k-th point is counted.
    """
    observations = model.observations
    image = np.repeat(np.arange(len(model.images)), np.diff(observations.offsets))
    known = observations.point_idx >= 0
    image, point = image[known], observations.point_idx[known]
    length = np.bincount(point, minlength=len(model.points))
    step = max(1, int(np.ceil(float((length.astype(np.float64) ** 2).sum()) / _MAX_PAIRS)))
    counted = point % step == 0
    image, point = image[counted], point[counted]
    sees = sparse.csr_array(
        (np.ones(len(image), dtype=np.int64), (image, point)), shape=(len(model.images), len(model.points))
    )
    sees.data[:] = 1  # an image that links a point twice sees it once
    both = sparse.triu(sees @ sees.T, k=1).tocoo()
    return np.column_stack([both.row, both.col]).astype(np.int64), both.data.astype(np.int64), 1.0 / step


def _finite_or_nan(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.nan)
