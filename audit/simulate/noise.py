"""How noisy simulated observations are, and which of them share their noise level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.optimize import brentq

from sfm_audit.loaders.arrays import FloatArray, IntArray

_T5_SD = math.sqrt(5.0 / 3.0)  # of Student's t with five degrees of freedom


class NoiseKind(StrEnum):
    """The laws of simulated measurement noise; all have the same standard deviation per axis, ``sigma_px``.

    GAUSSIAN, LAPLACE, STUDENT_T5: independent per axis.
    PER_TRACK_LOGNORMAL: Gaussian; one lognormal sigma per track, shared by all its observations.
    PER_OBSERVATION_SCALE: Gaussian; one lognormal sigma per observation (a keypoint's scale).
    TRUNCATED: what a filter at ``truncation_px`` leaves of a heavy-tailed law (bivariate t, 2 degrees of freedom).
    WRONG_MATCHES: Gaussian, but a share of the observations lies anywhere within ``truncation_px`` of the truth;
    here sigma_px is that of the right ones.
    """

    GAUSSIAN = "gaussian"
    LAPLACE = "laplace"
    STUDENT_T5 = "student_t5"
    PER_TRACK_LOGNORMAL = "per_track_lognormal"
    PER_OBSERVATION_SCALE = "per_observation_scale"
    TRUNCATED = "truncated"
    WRONG_MATCHES = "wrong_matches"


@dataclass(frozen=True, slots=True)
class NoiseSpec:
    """A law of noise.

    sigma_px: standard deviation per axis, px (of the right matches, if some are wrong).
    log_spread: standard deviation of ln sigma, for the two lognormal kinds.
    truncation_px: largest error length that a filter would have left (COLMAP: 4 px).
    wrong_share: of all observations, for WRONG_MATCHES.
    """

    kind: NoiseKind = NoiseKind.GAUSSIAN
    sigma_px: float = 0.5
    log_spread: float = 0.5
    truncation_px: float = 4.0
    wrong_share: float = 0.02

    def __post_init__(self) -> None:
        if not (self.sigma_px >= 0 and self.log_spread >= 0 and self.truncation_px > 0 and 0 <= self.wrong_share <= 1):
            raise ValueError(f"not a law of noise: {self}")
        if self.kind is NoiseKind.TRUNCATED and self.sigma_px >= 0.5 * self.truncation_px:
            raise ValueError(f"sigma_px must be below truncation_px / 2 (the uniform disc): {self}")


@dataclass(frozen=True, slots=True, eq=False)
class NoiseDraw:
    """Noise of m observations: ``xy_px`` (m, 2) and ``sigma_px`` (m,), the standard deviation per axis of each."""

    xy_px: FloatArray
    sigma_px: FloatArray


def draw_noise(spec: NoiseSpec, track_idx: IntArray, rng: np.random.Generator) -> NoiseDraw:
    """Draw the measurement noise of m observations.

    Parameters
    ----------
    track_idx : (m,) the track of each observation, >= 0; only PER_TRACK_LOGNORMAL looks at it

    Returns
    -------
    NoiseDraw
        px; ``sigma_px`` is constant unless the law has a scale per track or observation, or wrong matches.
    """
    m = len(track_idx)
    sigma = np.full(m, spec.sigma_px)
    match spec.kind:
        case NoiseKind.GAUSSIAN:
            unit = rng.standard_normal((m, 2))
        case NoiseKind.LAPLACE:
            unit = rng.laplace(scale=math.sqrt(0.5), size=(m, 2))
        case NoiseKind.STUDENT_T5:
            unit = rng.standard_t(5, size=(m, 2)) / _T5_SD
        case NoiseKind.PER_TRACK_LOGNORMAL:
            num_tracks = int(track_idx.max(initial=-1)) + 1
            sigma = sigma * _lognormal_with_unit_power(num_tracks, spec.log_spread, rng)[track_idx]
            unit = rng.standard_normal((m, 2))
        case NoiseKind.PER_OBSERVATION_SCALE:
            sigma = sigma * _lognormal_with_unit_power(m, spec.log_spread, rng)
            unit = rng.standard_normal((m, 2))
        case NoiseKind.TRUNCATED:
            return NoiseDraw(_truncated_t2(m, spec.sigma_px, spec.truncation_px, rng), sigma)
        case NoiseKind.WRONG_MATCHES:
            unit = rng.standard_normal((m, 2))
            wrong = rng.random(m) < spec.wrong_share
            disc = _isotropic(spec.truncation_px * np.sqrt(rng.random(m)), rng)
            sigma = np.where(wrong, 0.5 * spec.truncation_px, sigma)  # per axis: E r^2 / 2 = truncation^2 / 4
            return NoiseDraw(np.where(wrong[:, None], disc, unit * spec.sigma_px), sigma)
    return NoiseDraw(unit * sigma[:, None], sigma)


def _lognormal_with_unit_power(num: int, log_spread: float, rng: np.random.Generator) -> FloatArray:
    """(num,) lognormal factors with E factor^2 = 1, so that the overall standard deviation is the stated one."""
    return np.exp(log_spread * rng.standard_normal(num) - log_spread**2)


def _isotropic(radius: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(m, 2) vectors of the given lengths in uniform directions."""
    angle = rng.uniform(0.0, 2.0 * np.pi, len(radius))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _truncated_t2(num: int, sigma: float, limit: float, rng: np.random.Generator) -> FloatArray:
    """(num, 2) bivariate t with 2 degrees of freedom given |xy| <= limit, standard deviation sigma per axis.

    With q = r^2 / (2 s^2) the density is (1 + q)^-2, so F(q) = q / (1 + q) and, below a = limit^2 / (2 s^2),
    the variance per axis is s^2 E q = s^2 (ln(1 + a) (1 + a) / a - 1); s is solved from it.
    """
    if sigma == 0.0:
        return np.zeros((num, 2))

    def log_a(log_s: float) -> float:
        return 2.0 * (math.log(limit) - log_s) - math.log(2.0)

    def log_excess(log_s: float) -> float:
        mean_q = float(np.logaddexp(0.0, log_a(log_s))) * (1.0 + math.exp(-log_a(log_s))) - 1.0
        return 2.0 * (log_s - math.log(sigma)) + math.log(mean_q)

    log_s = brentq(log_excess, math.log(sigma) - 20.0, math.log(limit) + 5.0)
    share = rng.random(num) / (1.0 + math.exp(-log_a(log_s)))
    return _isotropic(math.exp(log_s) * np.sqrt(2.0 * share / (1.0 - share)), rng)
