"""From residuals to standard normal numbers under a noise model, by name (method.md sections 2 and 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.noise.fits import VarianceFit, fit_constant_variance, fit_variance
from sfm_audit.audit.noise.predictive import TrackStandardiser, predict
from sfm_audit.audit.noise.prior import TrackPrior, fit_prior_of_tracks
from sfm_audit.audit.noise.tracks import TrackStatistics, track_statistics
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

PREDICTOR_QUANTILE = 0.99  # predictors above it count as if they were there, in the paper's form (1) only


@dataclass(frozen=True, slots=True, eq=False)
class ImageNoise:
    """The noise of one image under one model; NaN where the model does not have the number.

    z: (m, 2) standardised residuals, x and y.          sigma_constant_px: robust sd per axis of the raw residuals.
    sigma_d_px, sigma_l: (1).   sigma_predicted_px: median f scale of (4).   scale_ratio: f^2 of (5).
    """

    z: FloatArray
    sigma_constant_px: float
    sigma_d_px: float
    sigma_l: float
    sigma_predicted_px: float
    scale_ratio: float
    converged: bool


def constant_noise(residuals_px: FloatArray) -> ImageNoise:
    """Noise model ``constant``: one robust scale for the raw residuals (2, n) of all inliers."""
    fit = fit_constant_variance(residuals_px**2)
    sigma = math.sqrt(fit.detector_px2)
    return ImageNoise(residuals_px.T / sigma, sigma, sigma, math.nan, sigma, math.nan, fit.converged)


@dataclass(frozen=True, slots=True, eq=False)
class ModelTracks:
    """Track statistics of all inliers of a model, from stationary images only, and the prior fitted to them.

    nonstationary: (I,) pose_offset_px above the threshold: left out of the tracks of all others, unless they are more
    than half of the images with inliers (too_many_nonstationary).
    offsets: (I + 1,) inliers by image.            verified_offsets: (I + 1,) verified inliers by image.
    standardiser: None where the prior is undetermined.
    """

    statistics: TrackStatistics
    nonstationary: BoolArray
    too_many_nonstationary: bool
    offsets: IntArray
    verified_offsets: IntArray
    prior: TrackPrior
    standardiser: TrackStandardiser | None


def model_tracks(
    residuals: ModelResiduals,
    num_points: int,
    *,
    pose_offset_threshold_px: float,
    min_track_length: int,
    min_eigenvalue: float,
) -> ModelTracks:
    """Whiten a model's residuals and fit its track prior.

    Notes
    -----
    method.md section 3b: wrong poses inflate everybody's a^2. An image with pose_offset_px above the threshold is left
    out of the tracks of all others and of the prior; its own observations keep the values of the full tracks. If more
    than half of the images (with inliers) exceed it, none is left out.
    """
    moved = residuals.pose_offset_px > pose_offset_threshold_px
    num_audited = int(np.count_nonzero(np.diff(residuals.offsets)))
    too_many = bool(2 * np.count_nonzero(moved) > num_audited)
    own_left_out = None if too_many or not moved.any() else np.repeat(moved, np.diff(residuals.offsets))
    statistics = track_statistics(
        residuals.residuals_px,
        residuals.point_jacobian,
        residuals.point_idx,
        num_points,
        min_track_length=min_track_length,
        min_eigenvalue=min_eigenvalue,
        left_out=own_left_out,
    )
    used = statistics.verified if own_left_out is None else statistics.verified & ~own_left_out
    prior = fit_prior_of_tracks(statistics, used)
    standardiser = None
    if math.isfinite(prior.nu0):
        prediction = predict(prior, statistics.others, statistics.verified.size, statistics.verified)
        standardiser = TrackStandardiser.build(prediction)
    verified = [
        np.count_nonzero(statistics.verified[first:last]) for first, last in pairwise(residuals.offsets.tolist())
    ]
    verified_offsets = np.concatenate([[0], np.cumsum(verified, dtype=np.int64)])
    return ModelTracks(statistics, moved, too_many, residuals.offsets, verified_offsets, prior, standardiser)


def track_noise(tracks: ModelTracks, image_idx: int, sigma_constant_px: float) -> ImageNoise:
    """Noise model ``track`` for the image in row ``image_idx`` of the model."""
    statistics = tracks.statistics
    rows = slice(int(tracks.offsets[image_idx]), int(tracks.offsets[image_idx + 1]))
    own = slice(int(tracks.verified_offsets[image_idx]), int(tracks.verified_offsets[image_idx + 1]))
    whitened = _verified_px(statistics, rows)
    if tracks.standardiser is None or whitened.size == 0:
        empty = np.full(whitened.T.shape, math.nan)
        return ImageNoise(empty, sigma_constant_px, math.nan, math.nan, math.nan, math.nan, converged=False)
    standardised = tracks.standardiser.standardise(whitened, own)
    paper = _paper_fit(statistics, rows, whitened)
    factor = standardised.factor
    return ImageNoise(
        standardised.z,
        sigma_constant_px,
        math.sqrt(paper.detector_px2),
        math.sqrt(paper.structure),
        _quantile(tracks.standardiser.prediction.scale_px[own], 0.5) * factor,
        factor**2,
        paper.converged and standardised.converged,
    )


def paper_fit(tracks: ModelTracks, image_idx: int) -> VarianceFit:
    """The paper's form (1), with a_k of (3), for the verified observations of an image; at least one."""
    rows = slice(int(tracks.offsets[image_idx]), int(tracks.offsets[image_idx + 1]))
    return _paper_fit(tracks.statistics, rows, _verified_px(tracks.statistics, rows))


def _verified_px(statistics: TrackStatistics, rows: slice) -> FloatArray:
    """Whitened residuals (2, m) of the verified observations among rows."""
    return statistics.whitened_px[:, rows].compress(statistics.verified[rows], axis=1)  # [:, verified] has columns


def _paper_fit(statistics: TrackStatistics, rows: slice, whitened_px: FloatArray) -> VarianceFit:
    verified = statistics.verified[rows]
    other_sq_px2, other_dof = statistics.others.of(rows)
    predictor = other_sq_px2.compress(verified)
    predictor /= other_dof.compress(verified)  # a_k^2 of (3)
    limit = _quantile(predictor, PREDICTOR_QUANTILE)
    return fit_variance(whitened_px * whitened_px, np.minimum(predictor, limit, out=predictor))


def _quantile(values: FloatArray, q: float) -> float:
    """Linear interpolation between order statistics, as numpy.quantile, at a tenth of its cost for short arrays."""
    position = q * (values.size - 1)
    low = int(position)
    kth = [low, min(low + 1, values.size - 1)]
    below, above = np.partition(values, kth)[kth]
    return float(below + (position - low) * (above - below))
