"""Do the ordered values lie on a straight line against normal order statistics? (Shapiro-Wilk, Royston's AS R94)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TypeVar

import numpy as np
from scipy import special

from sfm_audit.audit.normality.outcome import NOT_RUN, Outcome
from sfm_audit.audit.normality.samples import in_safe_range, is_finite_sample
from sfm_audit.loaders.arrays import FloatArray, IntArray

_Numbers = TypeVar("_Numbers", float, FloatArray)

# Royston's fits hold for 3 <= N <= 5000.
MIN_VALUES = 3
MAX_VALUES = 5000

# Coefficients of AS R94, lowest power first.
_C1 = (0.0, 0.221157, -0.147981, -2.07119, 4.434685, -2.706056)
_C2 = (0.0, 0.042981, -0.293762, -1.752461, 5.682633, -3.582633)
_MEAN_SMALL = (0.5440, -0.39978, 0.025054, -6.714e-4)
_LOG_SD_SMALL = (1.3822, -0.77857, 0.062767, -0.0020322)
_MEAN_LARGE = (-1.5861, -0.31082, -0.083751, 0.0038915)
_LOG_SD_LARGE = (-0.4803, -0.082676, 0.0030302)
_GAMMA = (-2.273, 0.459)


def shapiro_wilk(values: FloatArray) -> Outcome:
    """Shapiro and Wilk's W with Royston's weights and p-value, ``scipy.stats.shapiro``.

    Null hypothesis: the values are independent and normal with any mean and standard deviation.
    Assumes independence and a continuous distribution (ties shrink W).
    Blind to the order of the values, to mean and scale; at thousands of values it sees departures of no consequence,
    which is why it is shown with W.

    Parameters
    ----------
    values : (N,)
        Any unit, 3 <= N <= 5000; NaN result outside that range (Royston's p-value was fitted there only; thin more
        values first, see :func:`thin_observations`), if all are equal, or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` W in (0, 1], 1 for a perfect line.

    Notes
    -----
    Royston, "Remark AS R94: a remark on algorithm AS 181: the W-test for normality", Appl. Statistics 44 (1995)
    547-551.
    """
    return shapiro_wilk_sorted(np.sort(values)) if is_finite_sample(values) else NOT_RUN


def thin_observations(z: FloatArray) -> FloatArray:
    """Every ceil(2n / 5000)-th observation of z (n, 2), whole rows, so that at most 5000 values remain."""
    return z[:: max(1, math.ceil(z.size / MAX_VALUES))]


def shapiro_wilk_sorted(values_sorted: FloatArray) -> Outcome:
    """:func:`shapiro_wilk` of finite values in ascending order."""
    num_values = len(values_sorted)
    if not MIN_VALUES <= num_values <= MAX_VALUES or values_sorted[0] == values_sorted[-1]:
        return NOT_RUN
    values_sorted = in_safe_range(values_sorted)
    weights = _half_weights(num_values)
    half = len(weights)
    # The weights are antisymmetric: a_i (x_(N+1-i) - x_(i)) over half of the sample.
    projection = float(weights @ (values_sorted[: -half - 1 : -1] - values_sorted[:half]))
    deviation = values_sorted - values_sorted.mean()
    total = math.sqrt(float(deviation @ deviation))
    norm = math.sqrt(2.0 * float(weights @ weights))
    # 1 - W as a product keeps its digits where W is close to 1.
    one_minus_w = max(0.0, (norm * total - projection) * (norm * total + projection) / (norm * total) ** 2)
    return Outcome(1.0 - one_minus_w, _royston_p(one_minus_w, num_values))


def shapiro_wilk_of(statistics: Mapping[str, FloatArray], num_values: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return W and p (B,) each of samples of so many values (B,), NaN below 4, by `audit.normality.statistics`.

    Royston's weights of all but the outermost values are scores divided by one number, such that all squares sum to 1.
    """
    n = np.maximum(num_values, MIN_VALUES + 1).astype(np.float64)
    r, root = 1.0 / np.sqrt(n), np.sqrt(statistics["score_sq"])
    first = _polynomial(_C1, r) + statistics["score_1"] / root
    second = _polynomial(_C2, r) + statistics["score_2"] / root
    has_second = n > 5
    remaining = statistics["score_sq"] - 2.0 * statistics["score_1"] ** 2
    remaining -= np.where(has_second, 2.0 * statistics["score_2"] ** 2, 0.0)
    left = 1.0 - 2.0 * first**2 - np.where(has_second, 2.0 * second**2, 0.0)
    none = num_values <= MIN_VALUES
    scale = np.sqrt(np.where(none, 1.0, remaining) / np.where(none, 1.0, left))
    second = np.where(has_second, second, statistics["score_2"] / scale)
    projection = first * statistics["span_1"] + second * statistics["span_2"] + statistics["projection_rest"] / scale
    total = np.sqrt(statistics["total_sq"])
    one_minus_w = np.maximum(0.0, (total - projection) * (total + projection) / statistics["total_sq"])
    return np.where(none, math.nan, 1.0 - one_minus_w), np.where(none, math.nan, _royston_p_of(one_minus_w, n))


def _royston_p_of(one_minus_w: FloatArray, n: FloatArray) -> FloatArray:
    """`_royston_p` of (B,) each, n > 3."""
    with np.errstate(divide="ignore", invalid="ignore"):
        y, small = np.log(one_minus_w), n <= 11
        gamma, log_n = _polynomial(_GAMMA, n), np.log(n)
        mean = np.where(small, _polynomial(_MEAN_SMALL, n), _polynomial(_MEAN_LARGE, log_n))
        log_sd = np.where(small, _polynomial(_LOG_SD_SMALL, n), _polynomial(_LOG_SD_LARGE, log_n))
        p = special.ndtr((mean - np.where(small, -np.log(gamma - y), y)) / np.exp(log_sd))
    p = np.where(small & (y >= gamma), 0.0, p)
    return np.where(one_minus_w == 0.0, 1.0, p)


@lru_cache(maxsize=64)
def _half_weights(n: int) -> FloatArray:
    """Royston's approximate weights of the n // 2 largest values, largest first; all positive."""
    half = n // 2
    if n == MIN_VALUES:
        return np.array([math.sqrt(0.5)])
    score = -special.ndtri((np.arange(1.0, half + 1.0) - 0.375) / (n + 0.25))
    sum_squares = 2.0 * float(score @ score)
    r = 1.0 / math.sqrt(n)
    first = _polynomial(_C1, r) + score[0] / math.sqrt(sum_squares)
    if n <= 5:
        scale = math.sqrt((sum_squares - 2.0 * score[0] ** 2) / (1.0 - 2.0 * first**2))
        weights = score / scale
    else:
        second = _polynomial(_C2, r) + score[1] / math.sqrt(sum_squares)
        remaining = sum_squares - 2.0 * score[0] ** 2 - 2.0 * score[1] ** 2
        weights = score / math.sqrt(remaining / (1.0 - 2.0 * first**2 - 2.0 * second**2))
        weights[1] = second
    weights[0] = first
    weights.flags.writeable = False
    return np.asarray(weights, dtype=np.float64)


def _royston_p(one_minus_w: float, n: int) -> float:
    if n == MIN_VALUES:
        exact = 6.0 / math.pi * (math.asin(math.sqrt(1.0 - one_minus_w)) - math.asin(math.sqrt(0.75)))
        return min(1.0, max(0.0, exact))
    if one_minus_w == 0.0:
        return 1.0
    y = math.log(one_minus_w)
    if n <= 11:
        gamma = _polynomial(_GAMMA, n)
        if y >= gamma:
            return 0.0
        y = -math.log(gamma - y)
        mean, sd = _polynomial(_MEAN_SMALL, n), math.exp(_polynomial(_LOG_SD_SMALL, n))
    else:
        log_n = math.log(n)
        mean, sd = _polynomial(_MEAN_LARGE, log_n), math.exp(_polynomial(_LOG_SD_LARGE, log_n))
    return float(special.ndtr((mean - y) / sd))


def _polynomial(coefficients: tuple[float, ...], x: _Numbers) -> _Numbers:
    value = 0.0 * x
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value
