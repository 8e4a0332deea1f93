"""All tests of normality of many small samples of one size at once: numpy's overhead is paid once, not per image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import special

from sfm_audit.audit.normality.battery import NormalityTests, normality_tests
from sfm_audit.audit.normality.distances import MIN_POINTS_NORM, MIN_VALUES_FITTED
from sfm_audit.audit.normality.kolmogorov import kolmogorov_p_of_stack
from sfm_audit.audit.normality.moments import MIN_VALUES_DAGOSTINO, dagostino_pearson_of_stack
from sfm_audit.audit.normality.null_tables import NullTable, modified_exponential, modified_normal, null_p_of_stack
from sfm_audit.audit.normality.samples import SAFE_MAGNITUDE
from sfm_audit.audit.normality.shapiro import MIN_VALUES, shapiro_wilk_of_stack
from sfm_audit.loaders.arrays import BoolArray, FloatArray

MAX_POINTS: Final = 64
"""Larger samples are tested one by one: there the values cost more than the calls, and few have the same size."""
_MIN_SAMPLES: Final = 4
_MAX_VALUES_AT_ONCE: Final = 1 << 18

_Columns = dict[str, FloatArray]


def normality_tests_of(samples: Sequence[FloatArray]) -> list[NormalityTests]:
    """Return `normality_tests` of each of the samples (n, 2).

    Notes
    -----
    Samples of up to 64 points of which several have the same size are tested together. The numbers are those of
    `normality_tests` to rounding (sums over a row of a stack are added in another order). Samples that are not finite,
    all equal or beyond the range of fourth powers are left to it.
    """
    by_size: dict[int, list[int]] = {}
    for k, z in enumerate(samples):
        by_size.setdefault(len(z), []).append(k)
    out: dict[int, NormalityTests] = {}
    for size, members in by_size.items():
        if not 0 < size <= MAX_POINTS or len(members) < _MIN_SAMPLES:
            continue
        step = max(1, _MAX_VALUES_AT_ONCE // (2 * size))
        for start in range(0, len(members), step):
            part = members[start : start + step]
            stack = np.stack([samples[k] for k in part])
            usual = np.flatnonzero(_is_usual(stack))
            if usual.size:
                out.update(zip([part[i] for i in usual.tolist()], _tests_of_stack(stack[usual]), strict=True))
    return [out[k] if k in out else normality_tests(z) for k, z in enumerate(samples)]


def _is_usual(stack: FloatArray) -> BoolArray:
    """(B,) samples that are finite, not all equal, and whose fourth powers can be computed."""
    flat = stack.reshape(len(stack), -1)
    low, high = flat.min(axis=1), flat.max(axis=1)
    magnitude = np.maximum(high, -low)
    usual: BoolArray = (low < high) & (magnitude > SAFE_MAGNITUDE[0]) & (magnitude < SAFE_MAGNITUDE[1])
    return usual


def _tests_of_stack(stack: FloatArray) -> list[NormalityTests]:
    """Test (B, n, 2)."""
    values = np.ascontiguousarray(stack).reshape(len(stack), -1)
    num_values = values.shape[1]
    ascending = np.sort(values, axis=1)
    columns: _Columns = {}
    for name, (statistic, p) in {
        "ks": _against(special.ndtr(ascending)),
        "ks_fitted": _fitted(ascending),
        **_of_lengths(stack),
        "sw": _unknown(stack) if num_values <= MIN_VALUES else shapiro_wilk_of_stack(ascending),
    }.items():
        columns[f"{name}_stat"], columns[f"{name}_p"] = statistic, p
    columns |= _moments(values)
    names = list(columns)
    sw_num_values = num_values if num_values > MIN_VALUES else 0
    return [
        NormalityTests(num_values=num_values, sw_num_values=sw_num_values, **dict(zip(names, row, strict=True)))
        for row in np.stack(list(columns.values()), axis=1).tolist()
    ]


def _unknown(stack: FloatArray) -> tuple[FloatArray, FloatArray]:
    nothing = np.full(len(stack), math.nan)
    return nothing, nothing


def _distances(cdf: FloatArray) -> FloatArray:
    """Kolmogorov's D (B,) of distribution functions (B, N), ascending."""
    num_values = cdf.shape[1]
    excess = np.arange(1.0, num_values + 1.0) / -num_values + cdf
    return np.asarray(np.maximum(excess.max(axis=1) + 1.0 / num_values, -excess.min(axis=1)))


def _against(cdf: FloatArray) -> tuple[FloatArray, FloatArray]:
    distances = _distances(cdf)
    return distances, kolmogorov_p_of_stack(distances, cdf.shape[1])


def _fitted(ascending: FloatArray) -> tuple[FloatArray, FloatArray]:
    num_values = ascending.shape[1]
    if num_values < MIN_VALUES_FITTED:
        return _unknown(ascending)
    deviation = ascending - ascending.mean(axis=1, keepdims=True)
    sd = np.sqrt((deviation * deviation).sum(axis=1, keepdims=True) / (num_values - 1))
    distances = _distances(special.ndtr(deviation / sd))
    return distances, null_p_of_stack(NullTable.KS_FITTED, modified_normal(distances, num_values), num_values)


def _of_lengths(stack: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Both tests of |z|^2 / 2."""
    half_squares = np.sort(0.5 * (stack[:, :, 0] * stack[:, :, 0] + stack[:, :, 1] * stack[:, :, 1]), axis=1)
    num_points = stack.shape[1]
    scaled = _unknown(stack)
    if num_points >= MIN_POINTS_NORM:
        distances = _distances(-np.expm1(half_squares / -half_squares.mean(axis=1, keepdims=True)))
        modified = modified_exponential(distances, num_points)
        scaled = distances, null_p_of_stack(NullTable.KS_NORM, modified, num_points)
    return {"ks_norm": scaled, "ks_norm_unscaled": _against(-np.expm1(-half_squares))}


def _moments(values: FloatArray) -> _Columns:
    """Skewness, excess kurtosis, and what D'Agostino and Pearson make of them."""
    num_values = values.shape[1]
    deviation = values - values.mean(axis=1, keepdims=True)
    square = deviation * deviation
    m2 = square.mean(axis=1)
    skewness = (square * deviation).mean(axis=1) / m2**1.5
    kurtosis = (square * square).mean(axis=1) / (m2 * m2) - 3.0
    k2, p = _unknown(values)
    if num_values >= MIN_VALUES_DAGOSTINO:
        k2 = dagostino_pearson_of_stack(skewness, kurtosis, num_values)
        p = np.exp(-0.5 * k2)
    return {"dap_stat": k2, "dap_p": p, "skewness": skewness, "kurtosis_excess": kurtosis}
