"""Noise and goodness of fit of some images, as columns; what each needs on the way is let go of at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np

from sfm_audit.audit.decision.measured import MeasuredNoise
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.noise.stack import ConstantFits, constant_noises, track_noises
from sfm_audit.audit.noise.standardise import ImageNoise, ModelTracks
from sfm_audit.audit.normality import normality_columns_of
from sfm_audit.audit.table.given import Column
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_MAX_INLIERS_AT_ONCE: Final = 1 << 18
_MAX_IMAGES_AT_ONCE: Final = 512
_NOISE: Final = ("sigma_d_px", "sigma_l", "sigma_predicted_px", "scale_ratio")
_CHOSEN: Final = (
    *("ks_stat", "ks_p", "ks_fitted_p", "ks_norm_p", "ks_norm_unscaled_p", "dap_stat", "dap_p", "sw_stat", "sw_p"),
    *("skewness", "kurtosis_excess"),
)
_CONSTANT: Final = {
    "ks_constant_stat": "ks_stat",
    "ks_constant_p": "ks_p",
    "ks_fitted_constant_p": "ks_fitted_p",
    "ks_norm_constant_p": "ks_norm_p",
    "dap_constant_p": "dap_p",
    "sw_constant_p": "sw_p",
    "skewness_constant": "skewness",
    "kurtosis_constant": "kurtosis_excess",
}
_noise_of: Final = attrgetter(*_NOISE)


@dataclass(frozen=True, slots=True, eq=False)
class NoiseColumns:
    """Noise and tests of n images.

    num_standardised: (n,) observations with a z.    is_finite: (n,) whether all their z are.
    sigma_constant_px, converged: (n,); converged of the chosen noise model.    noise: (n, 4) its numbers.
    tests: (n, 12) of the chosen noise model: number of values, then `_CHOSEN`.    constant_tests: (n, 8) `_CONSTANT`.
    """

    num_standardised: IntArray
    is_finite: BoolArray
    sigma_constant_px: FloatArray
    converged: BoolArray
    noise: FloatArray
    tests: FloatArray
    constant_tests: FloatArray

    @property
    def measured(self) -> MeasuredNoise:
        """What decides."""
        return MeasuredNoise(
            self.num_standardised,
            self.tests[:, 0].astype(np.int64),
            self.tests[:, 1],
            self.tests[:, 2],
            self.is_finite,
        )

    @property
    def columns(self) -> dict[str, Column]:
        """Columns of the images table."""
        return {
            "num_standardised": self.num_standardised,
            "sigma_constant_px": self.sigma_constant_px,
            **dict(zip(_NOISE, self.noise.T, strict=True)),
            "noise_converged": np.ma.masked_array(self.converged, self.num_standardised == 0),
            **dict(zip(_CHOSEN, self.tests[:, 1:].T, strict=True)),
            **dict(zip(_CONSTANT, self.constant_tests.T, strict=True)),
        }


def noise_columns(
    residuals: ModelResiduals,
    tracks: ModelTracks | None,
    image_idxs: range,
    constant: ConstantFits,
    noise_of: Callable[[int, ImageNoise], ImageNoise],
) -> NoiseColumns:
    """Fit the noise of some images of a model and test what it leaves; those with few observations together.

    Parameters
    ----------
    tracks : where the chosen noise model is ``track``, else None        constant : of all images
    noise_of : an image's noise under the chosen model, given its row and its noise of one scale
    """
    parts = [
        _fitted(_noises(constant_noises(residuals, part, constant), tracks, part, noise_of))
        for part in _parts(image_idxs, residuals.offsets)
    ] or [_fitted([])]
    return NoiseColumns(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in NoiseColumns.__slots__}
    )


def _parts(image_idxs: range, offsets: IntArray) -> Iterator[range]:
    """Yield consecutive images whose noise and tests are asked together, by their inliers' offsets (I + 1,)."""
    start = image_idxs.start
    while start < image_idxs.stop:
        full = int(np.searchsorted(offsets, offsets[start] + _MAX_INLIERS_AT_ONCE, side="right")) - 1
        stop = min(max(full, start + 1), start + _MAX_IMAGES_AT_ONCE, image_idxs.stop)
        yield range(start, stop)
        start = stop


def _noises(
    constants: Sequence[ImageNoise],
    tracks: ModelTracks | None,
    part: range,
    noise_of: Callable[[int, ImageNoise], ImageNoise],
) -> list[tuple[ImageNoise, ImageNoise]]:
    """The noise of each image of a part under one scale, which is known, and under the chosen model."""
    sigma_px = {image: noise.sigma_constant_px for image, noise in zip(part, constants, strict=True)}
    chosens = {} if tracks is None else track_noises(tracks, part, sigma_px)
    return [(own, chosens.get(image) or noise_of(image, own)) for image, own in zip(part, constants, strict=True)]


def _fitted(noises: Sequence[tuple[ImageNoise, ImageNoise]]) -> NoiseColumns:
    chosen = [each for _, each in noises]
    of_chosen = normality_columns_of([each.z for each in chosen])
    of_constant = of_chosen
    if any(each is not constant for constant, each in noises):
        of_constant = normality_columns_of([constant.z for constant, _ in noises])
    return NoiseColumns(
        np.array([len(each.z) for each in chosen], dtype=np.int64),
        np.array([np.isfinite(each.z).all() for each in chosen], dtype=bool),
        np.array([constant.sigma_constant_px for constant, _ in noises], dtype=np.float64),
        np.array([each.converged for each in chosen], dtype=bool),
        np.array([_noise_of(each) for each in chosen], dtype=np.float64).reshape(-1, len(_NOISE)),
        np.stack([of_chosen[name] for name in ("num_values", *_CHOSEN)], axis=1, dtype=np.float64),
        np.stack([of_constant[name] for name in _CONSTANT.values()], axis=1, dtype=np.float64),
    )
