"""What is left of every single observation? The rows of ``RUN/observations``, one per inlier of a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.table import ModelLabels, build_table, schema
from sfm_audit.audit.table.given import Coded
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray
from sfm_audit.loaders.model import SparseModel

if TYPE_CHECKING:
    import pyarrow as pa

Standardised = Callable[[int], tuple[IntArray, FloatArray]]
"""From an image's row to the rows (m,) among its inliers that have a z, and their z (m, 2)."""


def observation_table(
    model: SparseModel,
    residuals: ModelResiduals,
    track_length: Int32Array,
    standardised: Standardised,
    labels: ModelLabels,
) -> pa.Table:
    """Return the table of all inliers, by image in file order, then by POINTS2D order.

    Parameters
    ----------
    model, residuals : the model and its inliers        track_length : (n,) audited observations of each inlier's track
    standardised : z under the noise model of the run   labels : the text columns that name the model
    """
    row, num_images = residuals.observation_row, len(model.images)
    image_idx = np.repeat(np.arange(num_images, dtype=np.int32), np.diff(residuals.offsets))
    z = np.full((2, len(row)), np.nan)
    for k in range(num_images):
        own, values = standardised(k)
        z[:, residuals.offsets[k] + own] = values.T
    one = np.zeros(len(row), dtype=np.int32)
    xy_px = model.observations.xy_px.take(row, axis=0)
    columns = {
        **{name: Coded(one, (text,)) for name, text in asdict(labels).items()},
        "image_id": model.images.image_id.take(image_idx),
        "image_name": Coded(image_idx, tuple(model.images.name)),
        "point2d_idx": model.observations.point2d_idx.take(row),
        "point3d_id": model.points.point3d_id.take(residuals.point_idx),
        "x_px": xy_px[:, 0],
        "y_px": xy_px[:, 1],
        "residual_x_px": residuals.residuals_px[0],
        "residual_y_px": residuals.residuals_px[1],
        "track_length": track_length,
        "z_x": z[0],
        "z_y": z[1],
    }
    return build_table(columns, schema("observations"))
