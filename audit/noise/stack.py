"""The noise of many images with few observations at once: numpy's overhead is paid once, not per image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.noise.fits import CONSISTENCY, CUTOFF, UNDETERMINED, VarianceFit, fit_variance
from sfm_audit.audit.noise.predictive import TrackStandardiser
from sfm_audit.audit.noise.standardise import PREDICTOR_QUANTILE, ImageNoise, ModelTracks, track_noise
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

MAX_OBSERVATIONS: Final = 64
"""Images with more are looked at one by one: there the values cost more than the calls, and few have as many."""
_MIN_IMAGES: Final = 4
_MAX_ITERATIONS: Final = 100


def constant_noises(residuals: ModelResiduals, image_idxs: Sequence[int]) -> dict[int, ImageNoise]:
    """Return `constant_noise` of the images of which several have the same, small number of inliers."""
    starts = residuals.offsets[:-1]
    out: dict[int, ImageNoise] = {}
    for size, images in _by_size(np.diff(residuals.offsets), image_idxs):
        columns = starts[images][:, None] + np.arange(size)
        residuals_px = np.ascontiguousarray(residuals.residuals_px[:, columns].transpose(1, 0, 2))  # (B, 2, n)
        fits = fit_constant_variances((residuals_px**2).reshape(len(images), -1))
        for image, own, fit in zip(images.tolist(), residuals_px, fits, strict=True):
            sigma = math.sqrt(fit.detector_px2)
            out[image] = ImageNoise(own.T / sigma, sigma, sigma, math.nan, sigma, math.nan, fit.converged)
    return out


def track_noises(
    tracks: ModelTracks, image_idxs: Sequence[int], sigma_constant_px: Mapping[int, float]
) -> dict[int, ImageNoise]:
    """Return `track_noise` of the images of which several have the same, small number of verified observations.

    sigma_constant_px : of at least those images that are to be looked at
    """
    known = [image for image in image_idxs if image in sigma_constant_px]
    out: dict[int, ImageNoise] = {}
    if tracks.standardiser is None:
        return out
    verified = np.flatnonzero(tracks.statistics.verified)
    for size, images in _by_size(np.diff(tracks.verified_offsets), known):
        rows = tracks.verified_offsets[images][:, None] + np.arange(size)
        out.update(_noises_of_stack(tracks, tracks.standardiser, images, (rows, verified[rows]), sigma_constant_px))
    return out


def _by_size(counts: IntArray, image_idxs: Sequence[int]) -> Iterator[tuple[int, IntArray]]:
    """Yield sizes with the images of that size, where there are several."""
    chosen = np.asarray(image_idxs, dtype=np.int64)
    sizes = counts[chosen]
    for size in range(1, MAX_OBSERVATIONS + 1):
        images = chosen[sizes == size]
        if images.size >= _MIN_IMAGES:
            yield size, images


def fit_constant_variances(sq_residuals_px2: FloatArray) -> list[VarianceFit]:
    """Return `fit_constant_variance` of each row of (B, m)."""
    y, size = sq_residuals_px2, sq_residuals_px2.shape[1]
    total = y.sum(axis=1)
    fitted = np.isfinite(total) & (total > 0.0)
    theta, converged = np.where(fitted, total / (size * CONSISTENCY), math.nan), np.zeros(len(y), dtype=bool)
    inside = np.ones(y.shape, dtype=bool)
    active = np.flatnonzero(fitted)
    for _ in range(_MAX_ITERATIONS):
        if not active.size:
            break
        inside[active] &= y[active] < CUTOFF**2 * theta[active][:, None]  # theta only falls: what is clipped stays so
        unclipped = np.where(inside[active], y[active], 0.0).sum(axis=1)
        denominator = size * CONSISTENCY - (size - inside[active].sum(axis=1)) * CUTOFF**2
        has_root = (denominator > 0.0) & (unclipped > 0.0)
        fitted[active[~has_root]] = False
        following = unclipped[has_root] / denominator[has_root]
        active = active[has_root]
        ended = np.abs(following - theta[active]) <= 1e-14 * following
        theta[active] = following
        converged[active[ended]] = True
        active = active[~ended]
    return [
        VarianceFit(variance, 0.0, converged=ended) if is_fitted else UNDETERMINED
        for variance, ended, is_fitted in zip(theta.tolist(), converged.tolist(), fitted.tolist(), strict=True)
    ]


def _noises_of_stack(
    tracks: ModelTracks,
    standardiser: TrackStandardiser,
    images: IntArray,
    where: tuple[IntArray, IntArray],
    sigma_constant_px: Mapping[int, float],
) -> Iterator[tuple[int, ImageNoise]]:
    """Yield the noise of images with equally many verified observations.

    where : (B, m) each, their rows in the prediction and their columns among all inliers
    """
    statistics, (rows, columns) = tracks.statistics, where
    whitened = np.ascontiguousarray(statistics.whitened_px[:, columns].transpose(1, 0, 2))
    predictor = statistics.other_sq_px2[columns] / statistics.other_dof[columns]  # a_k^2 of (3)
    predictor = np.minimum(predictor, _quantiles(predictor, PREDICTOR_QUANTILE)[:, None])
    z, log_factor, solved = _standardised(standardiser, whitened, rows)
    papers = _fits(whitened**2, predictor)
    median_px = _quantiles(standardiser.prediction.scale_px[rows], 0.5)
    for k, image in enumerate(images.tolist()):
        if not solved[k]:
            yield image, track_noise(tracks, image, sigma_constant_px[image])
            continue
        paper, factor = papers(k), math.exp(log_factor[k])
        yield (
            image,
            ImageNoise(
                z[k],
                sigma_constant_px[image],
                math.sqrt(paper.detector_px2),
                math.sqrt(paper.structure),
                float(median_px[k]) * factor,
                factor**2,
                paper.converged,
            ),
        )


def _quantiles(values: FloatArray, q: float) -> FloatArray:
    """Linear interpolation between order statistics of each row of (B, m): (B,)."""
    position = q * (values.shape[1] - 1)
    low = int(position)
    kth = [low, min(low + 1, values.shape[1] - 1)]
    below, above = np.partition(values, kth, axis=1)[:, kth].T
    return np.asarray(below + (position - low) * (above - below))


def _fits(sq_px2: FloatArray, predictor_px2: FloatArray) -> Callable[[int], VarianceFit]:
    """`fit_variance` of (B, 2, m) and (B, m): one constant where that is the answer, one by one where it is not."""
    constants = fit_constant_variances(sq_px2.reshape(len(sq_px2), -1))
    variance = np.array([fit.detector_px2 for fit in constants])
    excess = np.minimum(sq_px2 / variance[:, None, None], CUTOFF**2).sum(axis=1) / CONSISTENCY - sq_px2.shape[1]
    rises = (excess * predictor_px2).sum(axis=1) > 0.0

    def fit(k: int) -> VarianceFit:
        return fit_variance(sq_px2[k], predictor_px2[k]) if rises[k] else constants[k]

    return fit


def _standardised(
    standardiser: TrackStandardiser, whitened_px: FloatArray, rows: IntArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return z (B, m, 2), ln f (B,), and where `TrackStandardiser.standardise` converges; the same steps, side by side.

    Images that this loop does not solve are asked again one by one.
    """
    prediction = standardiser.prediction
    nu_row = prediction.nu_row[rows]
    nu = prediction.nu_values[nu_row]
    t = whitened_px / prediction.scale_px[rows][:, None, :]
    size = 2 * rows.shape[1]
    z = np.full((len(t), rows.shape[1], 2), math.nan)
    possible = np.isfinite(t).all(axis=(1, 2)) & (np.count_nonzero(t, axis=(1, 2)) * CUTOFF**2 > size * CONSISTENCY)
    log_f, before, before_excess = np.zeros(len(t)), np.full(len(t), math.nan), np.full(len(t), math.nan)
    low, high = np.full(len(t), -math.inf), np.full(len(t), math.inf)
    solved = np.zeros(len(t), dtype=bool)
    active = np.flatnonzero(possible)
    for _ in range(_MAX_ITERATIONS):
        if not active.size:
            break
        found = standardiser.transform_stack(
            t[active] * np.exp(-log_f[active])[:, None, None], nu_row[active], nu[active]
        )
        excess, slope = _robust_excesses(found)
        ended = np.abs(excess) <= 1e-10
        z[active[ended]], solved[active[ended]] = found[ended], True
        active, excess, slope = active[~ended], excess[~ended], slope[~ended]
        x = log_f[active]
        low[active] = np.where(excess > 0, x, low[active])
        high[active] = np.where(excess > 0, high[active], x)
        step = _steps(excess, slope, x - before[active], excess - before_excess[active])
        before[active], before_excess[active] = x, excess
        log_f[active] = _inside(x, step, low[active], high[active])
    return z, log_f, solved


def _robust_excesses(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """mean(min(z^2, c^2)) - kappa of each of (B, m, 2), and a guess of minus its derivative in ln f."""
    sq = (z * z).reshape(len(z), -1)
    inside = sq < CUTOFF**2
    unclipped = np.where(inside, sq, 0.0).sum(axis=1) / sq.shape[1]
    return unclipped + CUTOFF**2 * (1.0 - inside.sum(axis=1) / sq.shape[1]) - CONSISTENCY, 2.0 * unclipped


def _steps(excess: FloatArray, slope: FloatArray, moved: FloatArray, changed: FloatArray) -> FloatArray:
    """The secant's step; by the slope where there is no step before; without end where all are clipped."""
    with np.errstate(divide="ignore", invalid="ignore"):
        by_slope = np.where(slope > 0, excess / slope, np.copysign(math.inf, excess))
        return np.where(np.isfinite(moved) & (changed != 0), -excess * moved / changed, by_slope)


def _inside(x: FloatArray, step: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The next x, kept inside the bracket (bisected where the step leaves it) and within e^3 of the last."""
    trial = x + np.clip(step, -3.0, 3.0)
    bracketed = np.isfinite(low) & np.isfinite(high)
    with np.errstate(invalid="ignore"):
        otherwise = np.where(bracketed, 0.5 * (low + high), x + np.copysign(1.0, step))
    return np.where((low < trial) & (trial < high), trial, otherwise)
