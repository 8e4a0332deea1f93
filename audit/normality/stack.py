"""All tests of normality of many samples at once: p-values are asked for all of them together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar, cast

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
_Numbers = TypeVar("_Numbers", FloatArray, IntArray)


def normality_tests_of(samples: Sequence[FloatArray]) -> list[NormalityTests]:
    """Return `normality_tests` of each of the samples (n, 2).

    Notes
    -----
    The numbers are those of `normality_tests` to rounding (sums are added in another order). Samples that are not
    finite, all equal or beyond the range of fourth powers are left to it.
    """
    columns = normality_columns_of(samples)
    names = list(columns)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [NormalityTests(**dict(zip(names, row, strict=True))) for row in rows]


def normality_columns_of(samples: Sequence[FloatArray]) -> dict[str, FloatArray | IntArray]:
    """Return the fields of `NormalityTests` (B,) of the samples by name, as `normality_tests_of` does."""
    statistics, found = sample_statistics(samples)
    num_points = np.array([len(z) for z in samples], dtype=np.int64)
    usual = found if found.all() else np.flatnonzero(found)
    own = statistics if found.all() else {name: column[usual] for name, column in statistics.items()}
    counts, numbers = _tests(own, num_points[usual])
    if not found.all():
        counts = {name: _spread(column, usual, len(samples)) for name, column in counts.items()}
        numbers = {name: _spread(column, usual, len(samples)) for name, column in numbers.items()}
    for k in np.flatnonzero(~found).tolist():
        single = normality_tests(samples[k])
        for columns in (counts, numbers):
            for name, column in columns.items():
                column[k] = getattr(single, name)
    return {**counts, **numbers}


def _spread(column: _Numbers, rows: IntArray | BoolArray, size: int) -> _Numbers:
    """(size,) with the column in these rows."""
    out = np.zeros(size, dtype=column.dtype)
    out[rows] = column
    return cast("_Numbers", out)


def _tests(statistics: _Columns, num_points: IntArray) -> tuple[dict[str, IntArray], _Columns]:
    """Tests of samples of so many points (B,) by their statistics: counts, and numbers."""
    num_values = 2 * num_points
    step = np.maximum(-(-num_values // MAX_VALUES), 1)
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
    return {"num_values": num_values, "sw_num_values": thinned}, columns


def _where(holds: BoolArray, values: FloatArray) -> FloatArray:
    return np.where(holds, values, np.nan)
