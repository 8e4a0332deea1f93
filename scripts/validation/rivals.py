"""The rules that others decide by, on the same residuals: RMS, Olsson's quartiles, puzzlepaint's biasedness."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import pandas as pd

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders.arrays import FloatArray

_BINS: Final = 8  # per axis, over +- _HALF_EXTENT standard deviations
_HALF_EXTENT: Final = 2.5
_MEAN_NORM: Final = math.sqrt(math.pi / 2)  # of N(0, I) in the plane
_MIN_RESIDUALS: Final = 5  # cells with fewer are left out
PUBLISHED_CELLS: Final = 50
IMAGE_CELLS: Final = 8


def rival_columns(auditor: ModelAuditor) -> pd.DataFrame:
    """Return what the rival rules look at, a row per image."""
    residuals, observations = auditor.residuals, auditor.model.observations
    rows = []
    for image_idx, camera_idx in enumerate(auditor.model.images.camera_idx):
        where = residuals.rows(image_idx)
        camera = auditor.model.camera(int(camera_idx))
        own = residuals.residuals_px[:, where].T
        share = observations.xy_px[residuals.observation_row[where]] / (camera.width, camera.height)
        length = np.linalg.norm(own, axis=1)
        first, third = np.quantile(length, [0.25, 0.75])
        rows.append(
            {
                "olsson_rejects": not first <= length.mean() <= third,
                "biasedness_50": biasedness(own, share, PUBLISHED_CELLS),
                "biasedness_8": biasedness(own, share, IMAGE_CELLS),
            }
        )
    return pd.DataFrame(rows)


def biasedness(residuals_px: FloatArray, share: FloatArray, cells: int) -> float:
    """Return the median over cells x cells of the KL divergence of the residuals' histogram from a normal.

    Parameters
    ----------
    residuals_px : (n, 2)        share : (n, 2) position in the image, 0..1 along width and height

    Notes
    -----
    After Schöps, Larsson, Pollefeys and Sattler, "Why having 10,000 parameters in your camera model is better than
    twelve" (CVPR 2020) and its program puzzlepaint/camera_calibration: in every cell the residuals are scaled to the
    mean length of N(0, I) and counted in 8 x 8 bins over +- 2.5 (what lies beyond counts at the edge), cells with fewer
    than 5 residuals are left out. The measure was made for a calibration with 1e5 and more residuals. NaN without any.
    """
    column, row = np.minimum((share * cells).astype(np.int64), cells - 1).clip(0).T
    cell = row * cells + column
    counts = np.bincount(cell, minlength=cells * cells)
    usable = np.flatnonzero(counts >= _MIN_RESIDUALS)
    if not usable.size:
        return math.nan
    mean = np.bincount(cell, weights=np.linalg.norm(residuals_px, axis=1), minlength=cells * cells) / counts.clip(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = residuals_px * (_MEAN_NORM / mean[cell])[:, None]
    bins = ((scaled / _HALF_EXTENT + 1.0) * 0.5 * _BINS).clip(0, _BINS - 1).astype(np.int64)
    histogram = np.zeros((cells * cells, _BINS * _BINS))
    np.add.at(histogram, (cell, bins[:, 1] * _BINS + bins[:, 0]), 1.0)
    p = histogram[usable] / counts[usable, None]
    centre = ((np.arange(_BINS) + 0.5) / _BINS * 2.0 - 1.0) * _HALF_EXTENT
    q = np.exp(-0.5 * (centre[:, None] ** 2 + centre**2)).ravel()
    q /= q.sum()
    kl = np.where(p > 0, p * np.log(np.where(p > 0, p, 1.0) / q), 0.0).sum(axis=1)
    return float(np.median(kl))
