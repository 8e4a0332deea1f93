"""Are the third and fourth moments those of a normal distribution? (D'Agostino-Pearson)."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar, cast

import numpy as np

from sfm_audit.audit.normality.outcome import NOT_RUN, Outcome
from sfm_audit.audit.normality.samples import in_safe_range, is_finite_sample
from sfm_audit.loaders.arrays import FloatArray, IntArray

MIN_VALUES_DAGOSTINO = 8
_Numbers = TypeVar("_Numbers", float, FloatArray)


class Shape(NamedTuple):
    """Skewness m3 / m2^1.5 and excess kurtosis m4 / m2^2 - 3 of the sample, dimensionless; 0 and 0 for a normal."""

    skewness: float
    kurtosis_excess: float


def sample_shape(values: FloatArray) -> Shape:
    """Skewness and excess kurtosis from the biased central moments (divisor N), as SciPy's ``skew`` and ``kurtosis``.

    Parameters
    ----------
    values : (N,)
        Any unit.

    Returns
    -------
    Shape
        NaN where all values are equal, there are none, or not all are finite.
    """
    if not is_finite_sample(values) or values.max() == values.min():
        return Shape(math.nan, math.nan)
    values = in_safe_range(values)
    deviation = values - values.mean()
    square = deviation * deviation
    m2 = float(square.mean())
    m3 = float(square @ deviation) / len(values)
    m4 = float(square @ square) / len(values)
    return Shape(m3 / m2**1.5, m4 / (m2 * m2) - 3.0)


def dagostino_pearson(values: FloatArray) -> Outcome:
    r"""D'Agostino and Pearson's K^2, ``scipy.stats.normaltest``.

    Null hypothesis: the values are independent and normal with any mean and standard deviation.
    Assumes independence; x and y of one image point count as two values.
    Blind to whatever leaves the third and fourth moments alone, to mean and scale, to the order of the values and to
    where in the image they lie. One gross outlier rejects: the fourth moment is not robust; the paper finds the test
    too strict.

    Parameters
    ----------
    values : (N,)
        Any unit; NaN result for N < 8 (the skewness transformation is not defined), all equal, or not all finite.

    Returns
    -------
    Outcome
        ``statistic`` K^2 = Z_skewness^2 + Z_kurtosis^2, ``p`` = exp(-K^2 / 2), the tail of chi^2(2).

    Notes
    -----
    D'Agostino, "Transformation to normality of the null distribution of g1", Biometrika 57 (1970) 679-681; Anscombe &
    Glynn, "Distribution of the kurtosis statistic b2 for normal samples", Biometrika 70 (1983) 227-234; D'Agostino &
    Pearson, Biometrika 60 (1973) 613-622.
    """
    return dagostino_pearson_from_shape(sample_shape(values), len(values))


def dagostino_pearson_from_shape(shape: Shape, num_values: int) -> Outcome:
    """:func:`dagostino_pearson` from the biased moments of num_values values."""
    if num_values < MIN_VALUES_DAGOSTINO or math.isnan(shape.skewness):
        return NOT_RUN
    k2 = (
        _skewness_z(shape.skewness, float(num_values)) ** 2 + _kurtosis_z(shape.kurtosis_excess, float(num_values)) ** 2
    )
    return Outcome(float(k2), math.exp(-0.5 * k2))


def dagostino_pearson_of(skewness: FloatArray, kurtosis_excess: FloatArray, num_values: IntArray) -> FloatArray:
    """Return K^2 (B,) of the shapes (B,) each of samples of so many values (B,); meaningless below 8."""
    n = np.maximum(num_values, MIN_VALUES_DAGOSTINO).astype(np.float64)
    return np.asarray(_skewness_z(skewness, n) ** 2 + _kurtosis_z(kurtosis_excess, n) ** 2)


def _skewness_z(skewness: _Numbers, n: _Numbers) -> _Numbers:
    """D'Agostino (1970): standard normal under the null hypothesis, n >= 8."""
    y = skewness * np.sqrt((n + 1) * (n + 3) / (6.0 * (n - 2)))
    beta2 = 3.0 * (n * n + 27.0 * n - 70.0) * (n + 1) * (n + 3) / ((n - 2.0) * (n + 5) * (n + 7) * (n + 9))
    w2 = -1.0 + np.sqrt(2.0 * (beta2 - 1.0))
    delta = 1.0 / np.sqrt(0.5 * np.log(w2))
    alpha = np.sqrt(2.0 / (w2 - 1.0))
    z: _Numbers = delta * np.arcsinh(y / alpha)
    return z


def _kurtosis_z(kurtosis_excess: _Numbers, n: _Numbers) -> _Numbers:
    """Anscombe & Glynn (1983): standard normal under the null hypothesis."""
    mean = 3.0 * (n - 1) / (n + 1)
    variance = 24.0 * n * (n - 2) * (n - 3) / ((n + 1) * (n + 1.0) * (n + 3) * (n + 5))
    x = (kurtosis_excess + 3.0 - mean) / np.sqrt(variance)
    root_beta1 = (
        6.0
        * (n * n - 5.0 * n + 2.0)
        / ((n + 7) * (n + 9))
        * np.sqrt(6.0 * (n + 3) * (n + 5) / (n * (n - 2.0) * (n - 3)))
    )
    a = 6.0 + 8.0 / root_beta1 * (2.0 / root_beta1 + np.sqrt(1.0 + 4.0 / root_beta1**2))
    denominator = 1.0 + x * np.sqrt(2.0 / (a - 4.0))
    with np.errstate(divide="ignore"):
        term = np.copysign(np.cbrt((1.0 - 2.0 / a) / np.abs(denominator)), denominator)
    z = np.where(denominator == 0.0, math.nan, (1.0 - 2.0 / (9.0 * a) - term) / np.sqrt(2.0 / (9.0 * a)))
    return cast("_Numbers", z)
