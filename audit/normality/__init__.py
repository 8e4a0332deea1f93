"""Goodness of fit of standardised residuals to N(0, 1): method.md section 4.

In pytest modules import the package: an imported name ``normality_tests`` would be collected.
"""

from __future__ import annotations

from sfm_audit.audit.normality.battery import NormalityTests, normality_tests
from sfm_audit.audit.normality.distances import ks, ks_fitted, ks_norm, ks_norm_unscaled
from sfm_audit.audit.normality.moments import Shape, dagostino_pearson, sample_shape
from sfm_audit.audit.normality.outcome import Outcome
from sfm_audit.audit.normality.shapiro import shapiro_wilk, thin_observations
from sfm_audit.audit.normality.stack import normality_columns_of, normality_tests_of

__all__ = [
    "NormalityTests",
    "Outcome",
    "Shape",
    "dagostino_pearson",
    "ks",
    "ks_fitted",
    "ks_norm",
    "ks_norm_unscaled",
    "normality_columns_of",
    "normality_tests",
    "normality_tests_of",
    "sample_shape",
    "shapiro_wilk",
    "thin_observations",
]
