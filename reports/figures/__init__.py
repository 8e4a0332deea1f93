"""Pictures of residuals and of runs, for the report, for ``explain``, and for notebooks (docs/report.md).

Every function returns a `matplotlib.figure.Figure`, draws nothing on a screen and leaves matplotlib's settings as they
were. Needs the extra ``report``.
"""

from __future__ import annotations

from sfm_audit.reports.charts.captions import CAPTIONS
from sfm_audit.reports.charts.residuals import ResidualError, Residuals, read_residuals
from sfm_audit.reports.figures.cameras import expected_error, misfit_groups
from sfm_audit.reports.figures.normality import qq_plot, scale_comparison, standardised_histogram
from sfm_audit.reports.figures.runs import (
    RunColumns,
    histogram_by_verdict,
    ks_comparison,
    noise_comparison,
    verdict_bars,
)
from sfm_audit.reports.figures.sensor import (
    draw_residual_vectors,
    inliers_on_photo,
    radial_profile,
    residual_field,
    residual_vectors,
)
from sfm_audit.reports.figures.style import VERDICT_COLOURS

__all__ = [
    "CAPTIONS",
    "VERDICT_COLOURS",
    "ResidualError",
    "Residuals",
    "RunColumns",
    "draw_residual_vectors",
    "expected_error",
    "histogram_by_verdict",
    "inliers_on_photo",
    "ks_comparison",
    "misfit_groups",
    "noise_comparison",
    "qq_plot",
    "radial_profile",
    "read_residuals",
    "residual_field",
    "residual_vectors",
    "scale_comparison",
    "standardised_histogram",
    "verdict_bars",
]
