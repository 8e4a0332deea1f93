"""All tests of normality of many samples at once: p-values are asked for all of them together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm_audit.audit.normality.battery import NormalityTests, normality_tests
from sfm_audit.audit.normality.distances import MIN_POINTS_NORM, MIN_VALUES_FITTED
from sfm_audit.audit.normality.kolmogorov import kolmogorov_p_of
from sfm_audit.audit.normality.moments import MIN_VALUES_DAGOSTINO, dagostino_pearson_of
from sfm_audit.audit.normality.null_tables import NullTable, modified_exponential, modified_normal, null_p_of
from sfm_audit.audit.normality.shapiro import MAX_VALUES, MIN_VALUES, shapiro_wilk_of
from sfm_audit.audit.normality.statistics import sample_statistics
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_Columns = dict[str, FloatArray]


def normality_tests_of(samples: Sequence[FloatArray]) -> list[NormalityTests]:
    """Return `normality_tests` of each of the samples (n, 2).

    Notes
    -----
    The numbers are those of `normality_tests` to rounding (sums are added in another order). Samples that are not
    finite, all equal or beyond the range of fourth powers are left to it.
    """
    statistics, found = sample_statistics(samples)
    usual = np.flatnonzero(found)
    num_points = np.array([len(samples[k]) for k in usual.tolist()], dtype=np.int64)
    together = _tests({name: column[usual] for name, column in statistics.items()}, num_points)
    out = dict(zip(usual.tolist(), together, strict=True))
    return [out[k] if k in out else normality_tests(z) for k, z in enumerate(samples)]


def _tests(statistics: _Columns, num_points: IntArray) -> list[NormalityTests]:
    """Tests of samples of so many points (B,) by their statistics."""
    if not num_points.size:
        return []
    num_values = 2 * num_points
    step = -(-num_values // MAX_VALUES)
    thinned = np.where(num_values > MIN_VALUES, 2 * -(-num_points // step), 0)
    has_fit, has_shape = num_values >= MIN_VALUES_FITTED, num_values >= MIN_VALUES_DAGOSTINO
    columns: _Columns = {"ks_stat": statistics["ks"], "ks_norm_unscaled_stat": statistics["ks_norm_unscaled"]}
    columns["ks_p"] = kolmogorov_p_of(columns["ks_stat"], num_values)
    columns["ks_norm_unscaled_p"] = kolmogorov_p_of(columns["ks_norm_unscaled_stat"], num_points)
    columns["ks_fitted_stat"] = _where(has_fit, statistics["ks_fitted"])
    modified = modified_normal(columns["ks_fitted_stat"], num_values)
    columns["ks_fitted_p"] = null_p_of(NullTable.KS_FITTED, modified, num_values)
    columns["ks_norm_stat"] = _where(num_points >= MIN_POINTS_NORM, statistics["ks_norm"])
    modified = modified_exponential(columns["ks_norm_stat"], num_points)
    columns["ks_norm_p"] = null_p_of(NullTable.KS_NORM, modified, num_points)
    columns["skewness"] = statistics["m3"] / statistics["m2"] ** 1.5
    columns["kurtosis_excess"] = statistics["m4"] / (statistics["m2"] * statistics["m2"]) - 3.0
    k2 = dagostino_pearson_of(columns["skewness"], columns["kurtosis_excess"], num_values)
    columns["dap_stat"] = _where(has_shape, k2)
    columns["dap_p"] = np.exp(-0.5 * columns["dap_stat"])
    columns["sw_stat"], columns["sw_p"] = shapiro_wilk_of(statistics, thinned)
    names = list(columns)
    rows = np.stack(list(columns.values()), axis=1).tolist()
    return [
        NormalityTests(num_values=values, sw_num_values=used, **dict(zip(names, row, strict=True)))
        for values, used, row in zip(num_values.tolist(), thinned.tolist(), rows, strict=True)
    ]


def _where(holds: BoolArray, values: FloatArray) -> FloatArray:
    return np.where(holds, values, np.nan)
