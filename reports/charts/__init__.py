"""Figures written directly as SVG, for pages: a hundredth of the time that a drawing library takes (docs/report.md)."""

from __future__ import annotations

from sfm_audit.reports.charts.captions import CAPTIONS
from sfm_audit.reports.charts.residuals import ResidualError, Residuals, read_residuals

__all__ = ["CAPTIONS", "ResidualError", "Residuals", "read_residuals"]
