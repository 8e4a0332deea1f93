r"""Noise predicted from the size of keypoints: alone, and together with the rest of the track (method.md 2 and 3).

A keypoint found at a coarse scale is located coarsely. method.md's ``keypoint`` takes (1) with a = scale, on e of
section 3: a variance sigma_d^2 + sigma_l^2 s^2 per image. Both predictors together predict better than either one, and
are what ``--noise keypoint`` uses. Held-out log density of an image point, nats per observation, minus that of
``track``, on four components of internet photos with SIFT keypoints (scripts/compare_noise_models.py):

    verified observations     5007            4761            901             9949
    scale alone          -0.398 +- 0.087  -0.075 +- 0.013  -0.175 +- 0.036  -0.234 +- 0.038
    scale and track      +0.026 +- 0.005  +0.001 +- 0.001  +0.022 +- 0.013  +0.017 +- 0.004
    gamma                     0.53            0.08            0.46            0.43

The tests of normality do not notice the difference (KS rejects 10, 6, 11, 20 % of the images under ``track``, 0, 12,
11, 30 % under both; median excess kurtosis 0.30, -0.06, 0.32, 0.57 and 0.28, -0.06, 0.12, 0.66). The model:

    eps_k ~ N(0, v w_k^2),  w_k = (s_k / median s)^gamma,  v one per track, s0^2 nu0 / chi^2(nu0) over the model

Dividing eps_k and J_k by w_k makes this section 3 again, (2) to (5), with weighted tracks. The power gamma maximises
the likelihood of the tracks over the model; gamma = 0 is the noise model ``track``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.noise.fits import fit_variance
from sfm_audit.audit.noise.prior import NU0_RANGE
from sfm_audit.audit.noise.standardise import ImageNoise, ModelTracks, model_tracks, track_noise
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, IntArray

GAMMA_RANGE: Final = (0.0, 2.0)
_MAX_TRACKS: Final = 20_000  # a systematic subset of tracks is enough to fit one number
_MIN_TRACKS: Final = 20
_RANK_THRESHOLD: Final = 1e-10  # eigenvalues of the information with unit diagonal, as in audit.tracks
_TOLERANCE: Final = 1e-3  # of gamma: far below its standard error


@dataclass(frozen=True, slots=True)
class ScalePower:
    """How the noise grows with the keypoint scale: sd ~ scale^gamma; NaN where it could not be fitted.

    log_likelihood_gain: over gamma = 0, nats; twice it is chi^2(1) where scale does not matter (halved at the bound).
    num_tracks: tracks behind the fit.
    """

    gamma: float
    log_likelihood_gain: float
    num_tracks: int


@dataclass(frozen=True, slots=True, eq=False)
class KeypointTracks:
    """Tracks of the observations whose scale is known, weighted by it.

    tracks: as of the noise model ``track``, of residuals divided by ``weight``; its image offsets count known
    observations only.    known: (n,) columns of ModelResiduals with a scale.    scale_px: (k,) theirs, px.
    weight: (k,) w of the module's formula.    power: the fit of gamma.    median_scale_px: where w = 1.
    """

    tracks: ModelTracks
    known: BoolArray
    scale_px: FloatArray
    weight: FloatArray
    power: ScalePower
    median_scale_px: float


def keypoint_tracks(
    residuals: ModelResiduals,
    num_points: int,
    scale_px: FloatArray,
    *,
    pose_offset_threshold_px: float,
    min_track_length: int,
    min_eigenvalue: float,
) -> KeypointTracks:
    """Fit gamma and whiten a model's residuals with weights from keypoint scales.

    Parameters
    ----------
    residuals : all inliers of the model
    num_points : rows of the point table
    scale_px : (M,) px, per row of ``SparseModel.observations`` (``loaders.colmap_database``). Observations whose scale
        is not finite or not positive are left out of the tracks and are not standardised
    pose_offset_threshold_px, min_track_length, min_eigenvalue : as of `audit.noise.standardise.model_tracks`

    Notes
    -----
    Where gamma cannot be fitted (fewer than 20 tracks, or all residuals 0) every weight is 1.
    """
    scale = scale_px[residuals.observation_row]
    known = np.isfinite(scale) & (scale > 0.0)
    scale = scale[known]
    part = _only(residuals, known)
    median = float(np.median(scale)) if scale.size else math.nan
    log_scale = np.log(scale / median)
    steady = ~(part.pose_offset_px > pose_offset_threshold_px)
    if 2 * np.count_nonzero(~steady) > np.count_nonzero(np.diff(part.offsets)):  # method.md 3b: then none is left out
        steady[:] = True
    power = fit_scale_power(
        part.residuals_px, part.point_jacobian, part.point_idx, log_scale, np.repeat(steady, np.diff(part.offsets))
    )
    weight = np.exp((power.gamma if math.isfinite(power.gamma) else 0.0) * log_scale)
    weighted = replace(part, residuals_px=part.residuals_px / weight, point_jacobian=part.point_jacobian / weight)
    tracks = model_tracks(
        weighted,
        num_points,
        pose_offset_threshold_px=pose_offset_threshold_px,
        min_track_length=min_track_length,
        min_eigenvalue=min_eigenvalue,
    )
    return KeypointTracks(tracks, known, scale, weight, power, median)


def _only(residuals: ModelResiduals, known: BoolArray) -> ModelResiduals:
    """The inliers marked in ``known`` (n,); images keep their other numbers."""
    before = np.concatenate([[0], np.cumsum(known)])
    return replace(
        residuals,
        offsets=before[residuals.offsets],
        observation_row=residuals.observation_row[known],
        point_idx=residuals.point_idx[known],
        residuals_px=residuals.residuals_px[:, known],
        point_jacobian=residuals.point_jacobian[:, :, known],
    )


def fit_scale_power(
    residuals_px: FloatArray, point_jacobian: FloatArray, point_idx: IndexArray, log_scale: FloatArray, used: BoolArray
) -> ScalePower:
    r"""Fit gamma by maximum likelihood over the tracks of a model.

    Parameters
    ----------
    residuals_px : (2, n) px        point_jacobian : (2, 3, n) px per model unit        point_idx : (n,) track of each
    log_scale : (n,) ln of the relative keypoint scale        used : (n,) observations of stationary images

    Notes
    -----
    Given gamma, a track of L observations with m = 2 L - rank degrees of freedom has, after integrating over its point
    (flat prior) and its variance (s0^2 nu0 / chi^2(nu0)), with A and SS the weighted information and sum of squares,

        ln p = -2 gamma sum ln(s_k / median s) - ln det(A) / 2 + ln G((nu0 + m) / 2) - ln G(nu0 / 2)
               - m / 2 ln(pi P) - (nu0 + m) / 2 ln(1 + SS / P),    P = nu0 s0^2,

    maximised over (nu0, P) for every gamma. The likelihood of whole tracks is used here, not the leave-one-out form of
    method.md (4), because it needs no set of verified observations, which would change with gamma.
    """
    tracks = _chosen_tracks(point_idx, used)
    if len(tracks) < _MIN_TRACKS:
        return ScalePower(math.nan, math.nan, len(tracks))
    row_of = np.full(int(point_idx.max()) + 1, -1, dtype=np.int64)
    row_of[tracks] = np.arange(len(tracks))
    rows = np.flatnonzero(used & (row_of[point_idx] >= 0))
    sums = _TrackSums(
        residuals_px[:, rows], point_jacobian[:, :, rows], row_of[point_idx[rows]], log_scale[rows], len(tracks)
    )
    if not sums.residuals_px.any():
        return ScalePower(math.nan, math.nan, len(tracks))
    from scipy import optimize  # noqa: PLC0415 - a tenth of a second that the other noise models need not wait for

    found = optimize.minimize_scalar(
        lambda gamma: -sums.profile(float(gamma)), bounds=GAMMA_RANGE, method="bounded", options={"xatol": _TOLERANCE}
    )
    at_zero = sums.profile(0.0)
    gain = -float(found.fun) - at_zero
    return ScalePower(float(found.x), gain, len(tracks)) if gain > 0.0 else ScalePower(0.0, 0.0, len(tracks))


def _chosen_tracks(point_idx: IndexArray, used: BoolArray) -> IntArray:
    """Points with at least two used observations, a systematic subset where there are very many."""
    length = np.bincount(point_idx[used])
    tracks = np.flatnonzero(length >= 2)
    return tracks[:: max(1, math.ceil(len(tracks) / _MAX_TRACKS))]


@dataclass(frozen=True, slots=True, eq=False)
class _TrackSums:
    """The likelihood of gamma: residuals (2, n), Jacobians (2, 3, n), track and log scale (n,), number of tracks."""

    residuals_px: FloatArray
    jacobian: FloatArray
    track: IntArray
    log_scale: FloatArray
    num_tracks: int

    def profile(self, gamma: float) -> float:
        """Log likelihood, nats, at the best (nu0, P) for this gamma."""
        inverse = np.exp(-gamma * self.log_scale)
        jacobian, residuals = self.jacobian * inverse, self.residuals_px * inverse
        log_det, left, rank = self._profiled_points(jacobian, residuals)
        dof = (2 * np.bincount(self.track, minlength=self.num_tracks) - rank).astype(np.float64)
        inner = _best_prior(left, dof)
        return inner - 0.5 * float(log_det.sum()) - 2.0 * gamma * float(self.log_scale.sum())

    def _profiled_points(self, jacobian: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Log (pseudo-)determinant of A, sum of squares off A's column space, px^2, and rank, per track."""
        information = np.empty((self.num_tracks, 3, 3))
        gradient = np.empty((self.num_tracks, 3))
        for i in range(3):
            gradient[:, i] = self._sum((jacobian[:, i] * residuals).sum(axis=0))
            for j in range(i + 1):
                information[:, i, j] = information[:, j, i] = self._sum((jacobian[:, i] * jacobian[:, j]).sum(axis=0))
        scale = np.sqrt(np.einsum("pii->pi", information))
        scale[scale == 0.0] = 1.0
        values, vectors = np.linalg.eigh(information / (scale[:, :, None] * scale[:, None, :]))
        kept = values > _RANK_THRESHOLD * values[:, -1:]
        values = np.where(kept, values, 1.0)
        along = np.einsum("pij,pi->pj", vectors, gradient / scale)
        removed = np.where(kept, along**2 / values, 0.0).sum(axis=1)
        left = np.maximum(self._sum((residuals**2).sum(axis=0)) - removed, 0.0)
        log_det = np.log(values).sum(axis=1) + 2.0 * np.log(scale).sum(axis=1)
        return log_det, left, kept.sum(axis=1).astype(np.int64)

    def _sum(self, values: FloatArray) -> FloatArray:
        return np.bincount(self.track, weights=values, minlength=self.num_tracks).astype(np.float64, copy=False)


def _best_prior(sum_sq: FloatArray, dof: FloatArray) -> float:
    """Largest log likelihood over (nu0, P) of sums of squares (p,) with ``dof`` (p,) degrees of freedom, nats."""
    distinct, count = np.unique(dof, return_counts=True)
    total_dof = float(dof.sum())

    def minus(x: FloatArray) -> float:
        nu0, prior = math.exp(x[0]), math.exp(x[1])
        gammas = count @ (special.gammaln(0.5 * (nu0 + distinct)) - special.gammaln(0.5 * nu0))
        spread = (0.5 * (nu0 + dof)) @ np.log1p(sum_sq / prior)
        return float(spread + 0.5 * total_dof * math.log(math.pi * prior) - gammas)

    pooled = max(float(sum_sq.sum()) / max(total_dof, 1.0), float(np.finfo(np.float64).tiny))
    start = np.log([4.0, 4.0 * pooled])
    low, high = NU0_RANGE
    bounds = [(math.log(low), math.log(high)), (float(start[1]) - 30.0, float(start[1]) + 30.0)]
    from scipy import optimize  # noqa: PLC0415 - as above

    return -float(optimize.minimize(minus, start, method="L-BFGS-B", bounds=bounds).fun)


def keypoint_noise(
    keypoints: KeypointTracks, plain: ModelTracks, image_idx: int, sigma_constant_px: float
) -> ImageNoise:
    """Noise model ``keypoint`` for the image in row ``image_idx``: keypoint scale and track together.

    Parameters
    ----------
    keypoints : of `keypoint_tracks`        plain : unweighted tracks of the same inliers, for sigma_d and sigma_l
    sigma_constant_px : robust noise of the raw residuals, px

    Returns
    -------
    ImageNoise
        z of (5) with weighted tracks; sigma_predicted_px with the weights put back; sigma_d_px (px) and sigma_l (px of
        noise per px of scale) of the paper's form (1) with a = keypoint scale.
    """
    noise = track_noise(keypoints.tracks, image_idx, sigma_constant_px)
    tracks = keypoints.tracks
    columns = slice(int(tracks.offsets[image_idx]), int(tracks.offsets[image_idx + 1]))
    own = slice(int(tracks.verified_offsets[image_idx]), int(tracks.verified_offsets[image_idx + 1]))
    paper = _scale_alone(keypoints, plain, image_idx, sigma_constant_px)
    sigma_predicted = math.nan
    if tracks.standardiser is not None and own.stop > own.start:
        weight = keypoints.weight[columns][tracks.statistics.verified[columns]]
        scale = tracks.standardiser.prediction.scale_px[own] * weight
        sigma_predicted = float(np.median(scale)) * math.sqrt(noise.scale_ratio)
    return replace(
        noise,
        sigma_d_px=paper.sigma_d_px,
        sigma_l=paper.sigma_l,
        sigma_predicted_px=sigma_predicted,
        converged=noise.converged and paper.converged,
    )


def _scale_alone(keypoints: KeypointTracks, plain: ModelTracks, image_idx: int, sigma_constant_px: float) -> ImageNoise:
    """The paper's form (1) with a = scale, on e of the unweighted tracks of the image."""
    columns = slice(int(plain.offsets[image_idx]), int(plain.offsets[image_idx + 1]))
    known = keypoints.known[columns]
    tracks = keypoints.tracks
    scale = keypoints.scale_px[int(tracks.offsets[image_idx]) : int(tracks.offsets[image_idx + 1])]
    verified = plain.statistics.verified[columns]
    whitened = plain.statistics.whitened_px[:, columns][:, known & verified]
    return scale_only_noise(whitened, scale[verified[known]], sigma_constant_px)


def scale_only_noise(whitened_px: FloatArray, scale_px: FloatArray, sigma_constant_px: float) -> ImageNoise:
    """method.md's ``keypoint`` as it is written: (1) with a = keypoint scale, on e of section 3, one fit per image.

    Parameters
    ----------
    whitened_px : (2, m) e of verified observations, px        scale_px : (m,) their keypoint scales, px
    sigma_constant_px : robust noise of the raw residuals, px

    Returns
    -------
    ImageNoise
        z = e / sqrt(theta_1 + theta_2 s^2) of (P12); sigma_l in px per px of scale; NaN where undetermined.
    """
    predictor = scale_px**2
    fit = fit_variance((whitened_px**2).ravel(), np.tile(predictor, 2))
    variance = fit.detector_px2 + fit.structure * predictor
    return ImageNoise(
        (whitened_px / np.sqrt(variance)).T,
        sigma_constant_px,
        math.sqrt(fit.detector_px2),
        math.sqrt(fit.structure),
        float(np.median(np.sqrt(variance))) if variance.size else math.nan,
        math.nan,
        fit.converged,
    )
