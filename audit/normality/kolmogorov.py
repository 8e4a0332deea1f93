r"""How far is a sample from a fixed distribution, and how likely is that by chance? Kolmogorov-Smirnov.

p-values are closed forms on ``scipy.special``: ``scipy.stats`` costs more to import than an image costs to audit.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TypeVar

import numpy as np
from scipy import special

from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct

_Numbers = TypeVar("_Numbers", float, FloatArray)

# Where the two-sided p is below this, it is taken from the exact one-sided sum, which keeps its relative accuracy.
TAIL_P = 0.05
# Up to here every term of the one-sided sum is evaluated; beyond, this many of them (the terms are a smooth bell in j).
MAX_TERMS = 512
# Sums of that many terms whose temporaries stay in the processor's cache.
_MAX_SUMS = 64
# Below this many values Pelz and Good's series is replaced by Durbin's exact matrix.
MIN_SERIES_VALUES = 80

# Pelz & Good's sums run over all integers k, here over k >= 0 and k >= 1 once each; ten terms are enough below x = 1.5.
_ODD = math.pi**2 * (np.arange(10.0) + 0.5) ** 2
_WHOLE = math.pi**2 * np.arange(1.0, 11.0) ** 2
_ODD_POWERS = _ODD ** np.arange(4.0)[:, None]
_WHOLE_POWERS = _WHOLE ** np.arange(1.0, 3.0)[:, None]


def uniform_distance(cdf_sorted: FloatArray) -> float:
    """Kolmogorov's two-sided D of values whose hypothesised distribution function, in ascending order, is given.

    Parameters
    ----------
    cdf_sorted : (N,)
        F(z_(1)) <= ... <= F(z_(N)), dimensionless, N >= 1.

    Returns
    -------
    float
        max over i of max(i / N - F(z_(i)), F(z_(i)) - (i - 1) / N), between 1 / 2N and 1.
    """
    num_values = len(cdf_sorted)
    excess = np.arange(1.0, num_values + 1.0)
    excess /= -num_values
    excess += cdf_sorted
    return max(float(excess.max()) + 1.0 / num_values, -float(excess.min()))


def kolmogorov_p(distance: float, num_values: int) -> float:
    r"""P(D_N >= distance) for N independent values of the hypothesised, continuous distribution.

    Parameters
    ----------
    distance : float
        Two-sided D.
    num_values : int
        N >= 1.

    Returns
    -------
    float
        Agrees with the exact distribution to 1e-5, and to 1e-4 relative where p < 0.05, down to 1e-300. NaN for NaN.

    Notes
    -----
    Tail: twice the exact one-sided probability (Birnbaum & Tingey 1951), less Kolmogorov's next terms,
    p = 2 (q - q^4 + q^9 - ...). Body: Pelz & Good, "Approximating the lower tail-areas of the Kolmogorov-Smirnov
    one-sample statistic", JRSS B 38 (1976) 152-156; below 80 values Durbin's matrix (Marsaglia, Tsang & Wang,
    "Evaluating Kolmogorov's distribution", J. Stat. Software 8 (2003) 18).
    """
    if not distance >= 0.0:
        return math.nan
    if distance >= 1.0:
        return 0.0
    if 2.0 * num_values * distance <= 1.0:
        return 1.0
    scaled = distance * math.sqrt(num_values)
    if 2.0 * math.exp(-2.0 * scaled * scaled) < 2.0 * TAIL_P:
        one_sided = one_sided_p(distance, num_values)
        p = 2.0 * (one_sided - one_sided**4 + one_sided**9)
        if p < TAIL_P:
            return p
    if num_values < MIN_SERIES_VALUES:
        return min(1.0, 1.0 - _durbin_cdf(distance, num_values))
    return min(1.0, float(1.0 - _pelz_good_cdf(scaled, num_values)))


def kolmogorov_p_of(distances: FloatArray, num_values: IntArray) -> FloatArray:
    """Return `kolmogorov_p` of the distances (B,), finite, of samples of so many values (B,)."""
    p = np.where(distances >= 1.0, 0.0, 1.0)
    open_ = (distances < 1.0) & (2.0 * num_values * distances > 1.0)
    scaled = distances * np.sqrt(num_values)
    tail = np.flatnonzero(open_ & (2.0 * np.exp(-2.0 * scaled * scaled) < 2.0 * TAIL_P))
    one_sided = one_sided_p_of(distances[tail], num_values[tail])
    p[tail] = 2.0 * (one_sided - one_sided**4 + one_sided**9)
    open_[tail[p[tail] < TAIL_P]] = False
    for size in distinct(num_values[open_ & (num_values < MIN_SERIES_VALUES)]).tolist():
        body = np.flatnonzero(open_ & (num_values == size))
        p[body] = np.minimum(1.0, 1.0 - _durbin_of_stack(distances[body], size))
    body = np.flatnonzero(open_ & (num_values >= MIN_SERIES_VALUES))
    p[body] = np.minimum(1.0, 1.0 - _pelz_good_cdf(scaled[body], num_values[body]))
    return p


def one_sided_p_of(distances: FloatArray, num_values: IntArray) -> FloatArray:
    """Return `one_sided_p` of (B,) each."""
    out = np.empty(distances.shape)
    factorials = _log_factorials(int(num_values.max(initial=0)))
    for start in range(0, len(out), _MAX_SUMS):
        part = slice(start, start + _MAX_SUMS)
        out[part] = _one_sided(distances[part, None], num_values[part, None], factorials)
    return out


def _one_sided(distance: FloatArray, num_values: IntArray, factorials: FloatArray) -> FloatArray:
    """Sums (B,) of the terms of (B, 1) each."""
    stride = -(-num_values // MAX_TERMS)
    count = stride * np.arange(int((num_values // stride).max()) + 1)
    np.minimum(count, num_values, out=count)
    fraction = count / num_values
    rest = 1.0 - distance - fraction
    inside = (rest > 0.0) & (count <= np.floor(num_values * (1.0 - distance)))
    inside[:, 1:] &= count[:, 1:] > count[:, :-1]
    log_terms = factorials[num_values] - factorials[count] - factorials[num_values - count]
    log_terms += (count - 1.0) * np.log(distance + fraction)
    log_terms += (num_values - count) * np.log(np.where(inside, rest, 1.0))
    terms = np.exp(np.where(inside, log_terms, -math.inf))
    # One after the other: a sum in pairs would depend on how many terms the largest sample beside this one has.
    return np.asarray((distance * stride)[:, 0] * terms.cumsum(axis=1)[:, -1])


def _log_factorials(largest: int) -> FloatArray:
    """Ln 0!, ln 1!, ... up to that of ``largest`` at least."""
    return _log_factorials_below(1 << max(largest, 1).bit_length())


@lru_cache(maxsize=2)
def _log_factorials_below(size: int) -> FloatArray:
    return np.asarray(special.gammaln(np.arange(1.0, size + 1.0)))


def one_sided_p(distance: float, num_values: int) -> float:
    r"""P(D_N^+ >= d), Birnbaum & Tingey's sum of positive terms.

    d sum_j C(N, j) (d + j / N)^(j - 1) (1 - d - j / N)^(N - j), 0 <= j <= N (1 - d); above 512 values evaluated
    at every m-th j and multiplied by m.
    """
    last = math.floor(num_values * (1.0 - distance))
    count, log_binomial = _log_binomials(num_values)
    fraction = count / num_values
    rest = 1.0 - distance - fraction
    inside = (rest > 0.0) & (count <= last)
    count, fraction, rest, log_binomial = count[inside], fraction[inside], rest[inside], log_binomial[inside]
    log_terms = log_binomial + (count - 1.0) * np.log(distance + fraction) + (num_values - count) * np.log(rest)
    return float(distance * _stride(num_values) * np.exp(log_terms).sum())


def _stride(num_values: int) -> int:
    return -(-num_values // MAX_TERMS)


@lru_cache(maxsize=64)
def _log_binomials(num_values: int) -> tuple[FloatArray, FloatArray]:
    count = np.arange(0.0, num_values + 1.0, _stride(num_values))
    log_binomial = (
        special.gammaln(num_values + 1.0) - special.gammaln(count + 1.0) - special.gammaln(num_values - count + 1.0)
    )
    return count, log_binomial


def _durbin_cdf(distance: float, num_values: int) -> float:
    """P(D_N < distance), exact: N! / N^N times an entry of H^N."""
    k = math.floor(num_values * distance) + 1
    size = 2 * k - 1
    h = k - num_values * distance
    below, factorials = _durbin_shape(size)
    matrix = below.copy()
    powers = h ** np.arange(1.0, size + 1.0)
    matrix[:, 0] -= powers
    matrix[-1, :] -= powers[::-1]
    matrix[-1, 0] += max(0.0, 2.0 * h - 1.0) ** size
    matrix /= factorials
    # H / N before the power: entries stay below 1 and above 1e-200 for N < 80.
    power = np.linalg.matrix_power(matrix / num_values, num_values)
    return float(power[k - 1, k - 1] * special.gamma(num_values + 1.0))


def _durbin_of_stack(distances: FloatArray, num_values: int) -> FloatArray:
    """`_durbin_cdf` of (B,): those whose matrices have one size together."""
    out = np.empty_like(distances)
    k_of = np.floor(num_values * distances).astype(np.int64) + 1
    for k in distinct(k_of).tolist():
        chosen = np.flatnonzero(k_of == k)
        size = 2 * k - 1
        h = k - num_values * distances[chosen]
        below, factorials = _durbin_shape(size)
        matrix = np.tile(below, (len(chosen), 1, 1))
        powers = h[:, None] ** np.arange(1.0, size + 1.0)
        matrix[:, :, 0] -= powers
        matrix[:, -1, :] -= powers[:, ::-1]
        matrix[:, -1, 0] += np.maximum(0.0, 2.0 * h - 1.0) ** size
        matrix /= factorials
        power = np.linalg.matrix_power(matrix / num_values, num_values)
        out[chosen] = power[:, k - 1, k - 1] * special.gamma(num_values + 1.0)
    return out


@lru_cache(maxsize=16)
def _durbin_shape(size: int) -> tuple[FloatArray, FloatArray]:
    """(size, size): where Durbin's matrix is not zero, and the factorials that its entries are divided by."""
    row, col = np.indices((size, size))
    return np.where(row - col + 1 >= 0, 1.0, 0.0), special.gamma(np.maximum(row - col + 1, 0) + 1.0)


def _pelz_good_cdf(x: _Numbers, num_values: _Numbers | int | IntArray) -> _Numbers:
    r"""P(sqrt(N) D_N < x) = K0 + K1 / sqrt(N) + K2 / N + K3 / N^(3/2), Pelz & Good's equations."""
    x2 = x * x
    s0, s1, s2, s3 = _sums(_ODD_POWERS, np.exp(np.divide.outer(_ODD, -2.0 * x2)))
    t1, t2 = _sums(_WHOLE_POWERS, np.exp(np.divide.outer(_WHOLE, -2.0 * x2)))
    k0 = s0 / x
    k1 = (s1 - x2 * s0) / (6.0 * x**4)
    k2 = ((6.0 * x2 + 2.0) * x2**2 * s0 + (2.0 * x2 - 5.0) * x2 * s1 + (1.0 - 2.0 * x2) * s2) / (72.0 * x**7) - (
        t1 / (36.0 * x**3)
    )
    k3 = (
        -(30.0 + 90.0 * x2) * x2**3 * s0
        + (135.0 - 96.0 * x2) * x2**2 * s1
        + (212.0 * x2 - 60.0) * x2 * s2
        + (5.0 - 30.0 * x2) * s3
    ) / (6480.0 * x**10) + (3.0 * x2 * t1 - t2) / (216.0 * x**6)
    root = np.sqrt(num_values)
    cdf: _Numbers = math.sqrt(2.0 * math.pi) * (k0 + (k1 + (k2 + k3 / root) / root) / root)
    return cdf


def _sums(powers: FloatArray, terms: FloatArray) -> FloatArray:
    """(p, ...) sums of terms (k, ...) times powers (p, k), one term after the other.

    Not a product of matrices: that adds in an order which depends on how many samples there are beside this one.
    """
    return np.asarray(sum(np.multiply.outer(column, term) for column, term in zip(powers.T, terms, strict=True)))
