"""The noise of many images with few observations at once: numpy's overhead is paid once, not per image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels import noise as kernel
from sfm_audit.audit.noise.fits import (
    CONSISTENCY,
    CUTOFF,
    UNDETERMINED,
    VarianceFit,
    fit_constant_variance,
    fit_variance,
)
from sfm_audit.audit.noise.predictive import LAST_STEP, MIN_SLOPE, TrackStandardiser, robust_excess, student_to_normal
from sfm_audit.audit.noise.standardise import PREDICTOR_QUANTILE, ImageNoise, ModelTracks, paper_fit, track_noise
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

MAX_OBSERVATIONS: Final = 64
"""Images with more are looked at one by one: there the values cost more than the calls, and few have as many."""
_MIN_IMAGES: Final = 4
_MAX_ITERATIONS: Final = 100


class ConstantFits(NamedTuple):
    """Noise model ``constant`` of all images: (I,) each; sigma_px NaN where undetermined."""

    sigma_px: FloatArray
    converged: BoolArray


def constant_fits(residuals: ModelResiduals) -> ConstantFits:
    """Fit one robust scale to the raw residuals of each image."""
    num_images = len(residuals.offsets) - 1
    variances, converged = np.full(num_images, math.nan), np.ones(num_images, dtype=np.bool_)
    if kernel.available():
        variances = kernel.constant_variances(residuals.residuals_px, residuals.offsets, CONSISTENCY)
    else:
        for size, images in _by_size(np.diff(residuals.offsets), range(num_images)):
            fits = fit_constant_variances((_residuals_px(residuals, images, size) ** 2).reshape(len(images), -1))
            variances[images] = [fit.detector_px2 for fit in fits]
            converged[images] = [fit.converged for fit in fits]
    for image in np.flatnonzero(np.isnan(variances)).tolist():
        fit = fit_constant_variance(residuals.residuals_px[:, residuals.rows(image)] ** 2)
        variances[image], converged[image] = fit.detector_px2, fit.converged
    return ConstantFits(np.sqrt(variances), converged)


def constant_noises(residuals: ModelResiduals, image_idxs: range, fits: ConstantFits) -> list[ImageNoise]:
    """Return `constant_noise` of images that follow each other, whose fits are known."""
    offsets = residuals.offsets[image_idxs.start : image_idxs.stop + 1]
    own = slice(image_idxs.start, image_idxs.stop)
    standardised = np.divide(
        residuals.residuals_px[:, offsets[0] : offsets[-1]].T,
        np.repeat(fits.sigma_px[own], np.diff(offsets))[:, None],
        order="C",
    )
    ends = (offsets - offsets[0]).tolist()
    numbers = zip(ends, ends[1:], fits.sigma_px[own].tolist(), fits.converged[own].tolist(), strict=False)
    return [
        ImageNoise(standardised[start:stop], sigma, sigma, math.nan, sigma, math.nan, converged)
        for start, stop, sigma, converged in numbers
    ]


def track_noises(
    tracks: ModelTracks, image_idxs: Sequence[int], sigma_constant_px: Mapping[int, float]
) -> dict[int, ImageNoise]:
    """Return `track_noise` of those images that can be looked at together.

    With compiled kernels nearly all, where they follow each other; else those of which several have the same, small
    number of verified observations.

    sigma_constant_px : of at least those images that are to be looked at
    """
    known = [image for image in image_idxs if image in sigma_constant_px]
    out: dict[int, ImageNoise] = {}
    if tracks.standardiser is None:
        return out
    if kernel.available() and _follow_each_other(known):
        return _compiled_track_noises(tracks, tracks.standardiser, known, sigma_constant_px)
    verified = np.flatnonzero(tracks.statistics.verified)
    for size, images in _by_size(np.diff(tracks.verified_offsets), known):
        rows = tracks.verified_offsets[images][:, None] + np.arange(size)
        out.update(_noises_of_stack(tracks, tracks.standardiser, images, (rows, verified[rows]), sigma_constant_px))
    return out


def _residuals_px(residuals: ModelResiduals, images: IntArray, size: int) -> FloatArray:
    """Residuals (B, 2, n) of images with ``size`` inliers each."""
    columns = residuals.offsets[images][:, None] + np.arange(size)
    return np.ascontiguousarray(residuals.residuals_px[:, columns].transpose(1, 0, 2))


def _follow_each_other(image_idxs: Sequence[int]) -> bool:
    return len(image_idxs) > 0 and list(image_idxs) == list(range(image_idxs[0], image_idxs[0] + len(image_idxs)))


def _compiled_track_noises(
    tracks: ModelTracks,
    standardiser: TrackStandardiser,
    image_idxs: Sequence[int],
    sigma_constant_px: Mapping[int, float],
) -> dict[int, ImageNoise]:
    part = slice(image_idxs[0], image_idxs[-1] + 2)
    statistics, prior = tracks.statistics, tracks.prior
    verified_offsets = tracks.verified_offsets[part]
    columns = slice(int(tracks.offsets[part][0]), int(tracks.offsets[part][-1]))
    verified, others = statistics.verified[columns], statistics.others.of(columns)
    found = kernel.Tracks(
        *(np.ascontiguousarray(statistics.whitened_px[:, columns]), verified, *others),
        *(prior.nu0, prior.s0_px, standardiser.prediction.dof_values, standardiser.tables),
    ).noises(tracks.offsets[part] - columns.start, verified_offsets, CONSISTENCY)
    starts = (verified_offsets - verified_offsets[0]).tolist()
    _transform_outside(found, standardiser, others[1][verified])
    out: dict[int, ImageNoise] = {}
    with np.errstate(invalid="ignore"):
        detector, structure = np.sqrt(found.detector_px2).tolist(), np.sqrt(found.structure).tolist()
        predicted = (found.median_scale_px * np.sqrt(found.factor_sq)).tolist()
    for k, image in enumerate(image_idxs):
        if found.status[k] not in {kernel.DONE, kernel.FIT_IS_LEFT}:
            continue
        own = ImageNoise(
            found.z[starts[k] : starts[k + 1]],
            *(sigma_constant_px[image], detector[k], structure[k], predicted[k], float(found.factor_sq[k])),
            converged=True,
        )
        if found.status[k] == kernel.FIT_IS_LEFT:
            fit = paper_fit(tracks, image)
            pair = math.sqrt(fit.detector_px2), math.sqrt(fit.structure)
            own = replace(own, sigma_d_px=pair[0], sigma_l=pair[1], converged=fit.converged)
        out[image] = own
    return out


def _transform_outside(found: kernel.TrackNoises, standardiser: TrackStandardiser, other_dof: Int32Array) -> None:
    """Transform the t that are beyond the tables, where z holds them; other_dof: (V,) of the rows of z."""
    row, axis = np.nonzero(found.outside)
    if row.size:
        nu = standardiser.prediction.prior.nu0 + (other_dof[row] + axis).astype(np.float64)
        found.z[row, axis] = student_to_normal(found.z[row, axis], nu)


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
    other_sq_px2, other_dof = statistics.others.of(columns)
    predictor = other_sq_px2 / other_dof  # a_k^2 of (3)
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
    log_f, low, high = np.zeros(len(t)), np.full(len(t), -math.inf), np.full(len(t), math.inf)
    solved = np.zeros(len(t), dtype=bool)
    active = np.flatnonzero(possible)
    for _ in range(_MAX_ITERATIONS):
        if not active.size:
            break
        own = t[active], nu_row[active], nu[active]
        found, growth = standardiser.transform_stack(own[0] * np.exp(-log_f[active])[:, None, None], *own[1:])
        excess, slope = robust_excess(found, growth)
        x = log_f[active]
        low[active] = np.where(excess > 0, x, low[active])
        high[active] = np.where(excess > 0, high[active], x)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(slope > MIN_SLOPE, excess / slope, np.copysign(math.inf, excess))
        ended = np.abs(step) <= LAST_STEP
        log_f[active] = np.where(ended, x + step, _inside(x, step, low[active], high[active]))
        last = active[ended]
        if last.size:
            by_f = np.exp(-log_f[last])[:, None, None]
            z[last], solved[last] = standardiser.transform_stack(t[last] * by_f, nu_row[last], nu[last])[0], True
        active = active[~ended]
    return z, log_f, solved


def _inside(x: FloatArray, step: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The next x, kept inside the bracket (bisected where the step leaves it) and within e^3 of the last."""
    trial = x + np.clip(step, -3.0, 3.0)
    bracketed = np.isfinite(low) & np.isfinite(high)
    with np.errstate(invalid="ignore"):
        otherwise = np.where(bracketed, 0.5 * (low + high), x + np.copysign(1.0, step))
    return np.where((low < trial) & (trial < high), trial, otherwise)
