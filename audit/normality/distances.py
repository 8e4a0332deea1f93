"""Do values, or lengths of 2-vectors, follow the normal distribution in their whole range? Kolmogorov-Smirnov.

Every test comes twice: for values in any order, and ``*_sorted`` for callers that sort once for several tests.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from sfm_audit.audit.normality.kolmogorov import kolmogorov_p, uniform_distance
from sfm_audit.audit.normality.null_tables import NullTable, modified_exponential, modified_normal, null_p
from sfm_audit.audit.normality.outcome import NOT_RUN, Outcome
from sfm_audit.audit.normality.samples import in_safe_range, is_finite_sample
from sfm_audit.loaders.arrays import FloatArray

MIN_VALUES_FITTED = 3
MIN_POINTS_NORM = 2


def ks(values: FloatArray) -> Outcome:
    """Two-sided Kolmogorov-Smirnov test against N(0, 1) exactly: the paper's test.

    Null hypothesis: the values are independent and N(0, 1); nothing was estimated from them.
    Assumes just that. Pose and scale *were* fitted to them, so the test is conservative: it rejects fewer than 5 % of
    correct images, 0 % for homoscedastic noise.
    Blind to tails (its weight lies at the median), to the order of the values and to where in the image they lie.

    Parameters
    ----------
    values : (N,)
        Standardised residuals, dimensionless; NaN result if none or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` D, the largest difference of the distribution functions; ``p`` of Kolmogorov's distribution.

    Notes
    -----
    p: see :func:`audit.normality.kolmogorov.kolmogorov_p`.
    """
    return ks_sorted(np.sort(values)) if is_finite_sample(values) else NOT_RUN


def ks_sorted(values_sorted: FloatArray) -> Outcome:
    """:func:`ks` of finite values in ascending order."""
    return _with_kolmogorov_p(special.ndtr(values_sorted))


def ks_fitted(values: FloatArray) -> Outcome:
    """Lilliefors' test: KS against the normal distribution with the sample's own mean and sd (ddof = 1).

    Null hypothesis: the values are independent and normal with any mean and standard deviation.
    Assumes independence and equal variances. Of all that was fitted to the image only mean and sd are accounted for,
    not the degrees of freedom that pose and intrinsics took.
    Blind to location and scale by construction, to the tails like every KS test, and to the order of the values.

    Parameters
    ----------
    values : (N,)
        Any unit, N >= 3; NaN result if fewer, all equal, or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` D after centring and scaling (not modified); ``p`` from the packaged simulated null distribution
        of Stephens' D (sqrt N - 0.01 + 0.85 / sqrt N), by N.

    Notes
    -----
    Lilliefors, "On the Kolmogorov-Smirnov test for normality with mean and variance unknown", JASA 62 (1967) 399-402;
    Stephens, "EDF statistics for goodness of fit and some comparisons", JASA 69 (1974) 730-737. Departure: Stephens
    takes the modified statistic's null distribution as free of N; its 5 % point moves from 0.892 (N = 25) to 0.909
    (N = 2e4), so the table has N as well.
    """
    return ks_fitted_sorted(np.sort(values)) if is_finite_sample(values) else NOT_RUN


def ks_fitted_sorted(values_sorted: FloatArray) -> Outcome:
    """:func:`ks_fitted` of finite values in ascending order."""
    num_values = len(values_sorted)
    if num_values < MIN_VALUES_FITTED or values_sorted[0] == values_sorted[-1]:
        return NOT_RUN
    values_sorted = in_safe_range(values_sorted)
    deviation = values_sorted - values_sorted.mean()
    sd = math.sqrt(float(deviation @ deviation) / (num_values - 1))
    distance = uniform_distance(special.ndtr(deviation / sd))
    return Outcome(distance, null_p(NullTable.KS_FITTED, modified_normal(distance, num_values), num_values))


def ks_norm(z: FloatArray) -> Outcome:
    """Kolmogorov-Smirnov test of |z| against the Rayleigh distribution with the sample's own scale.

    |z|^2 / 2 is scaled to mean 1 and compared with Exp(1).
    Null hypothesis: the 2-vectors are independent and bivariate normal, isotropic, mean 0, of any one variance.
    Assumes independence of the vectors, and of x and y within each.
    Blind to the scale, to the directions of the vectors and to where in the image they lie.

    Parameters
    ----------
    z : (n, 2)
        Any unit, n >= 2; NaN result if fewer, all zero, or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` D; ``p`` from the packaged simulated null distribution of Stephens'
        (D - 0.2 / n) (sqrt n + 0.26 + 0.5 / sqrt n), by n.

    Notes
    -----
    Lilliefors, "On the Kolmogorov-Smirnov test for the exponential distribution with mean unknown", JASA 64 (1969)
    387-389; Stephens (1974), as for :func:`ks_fitted`.
    """
    return ks_norm_sorted(half_squares_sorted(in_safe_range(z))) if is_finite_sample(z) else NOT_RUN


def ks_norm_sorted(half_squares_sorted: FloatArray) -> Outcome:
    """:func:`ks_norm` from |z|^2 / 2 in ascending order."""
    num_points = len(half_squares_sorted)
    if num_points < MIN_POINTS_NORM or half_squares_sorted[-1] == 0.0:
        return NOT_RUN
    distance = uniform_distance(-np.expm1(half_squares_sorted / -half_squares_sorted.mean()))
    return Outcome(distance, null_p(NullTable.KS_NORM, modified_exponential(distance, num_points), num_points))


def ks_norm_unscaled(z: FloatArray) -> Outcome:
    """Kolmogorov-Smirnov test of |z|^2 / 2 against Exp(1): what reproduces the paper's Figure 3.

    Null hypothesis: the 2-vectors are independent and N(0, I); nothing was estimated from them.
    Assumes just that; conservative after fitting, like :func:`ks`.
    Blind to the directions of the vectors and to where in the image they lie.

    Parameters
    ----------
    z : (n, 2)
        Standardised residuals, dimensionless; NaN result if none or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` D; ``p`` of Kolmogorov's distribution for n values.
    """
    return ks_norm_unscaled_sorted(half_squares_sorted(z)) if is_finite_sample(z) else NOT_RUN


def ks_norm_unscaled_sorted(half_squares_sorted: FloatArray) -> Outcome:
    """:func:`ks_norm_unscaled` from |z|^2 / 2 in ascending order."""
    return _with_kolmogorov_p(-np.expm1(-half_squares_sorted))


def half_squares_sorted(z: FloatArray) -> FloatArray:
    """|z|^2 / 2 of each row of z (n, 2), ascending: Exp(1) for standard normal z. inf where squares overflow."""
    with np.errstate(over="ignore"):
        return np.sort(0.5 * (z[:, 0] * z[:, 0] + z[:, 1] * z[:, 1]))


def _with_kolmogorov_p(cdf_sorted: FloatArray) -> Outcome:
    distance = uniform_distance(cdf_sorted)
    return Outcome(distance, kolmogorov_p(distance, len(cdf_sorted)))
