"""One image's residuals as charts and figures take them. Needs no matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from threadpoolctl import threadpool_limits

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.reports.charts.residuals import Residuals, principal_point


def image_residuals_of(auditor: ModelAuditor, image_idx: int, row: Mapping[str, Any]) -> Residuals:
    """Return what the figures need of the image in row ``image_idx`` of the model; ``row``: of ``RUN/images``."""
    with threadpool_limits(limits=1, user_api="blas"):
        _, z = auditor.standardised(image_idx)
        inliers = auditor.inliers(image_idx)
        residuals_px = auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)].T
    return Residuals.build(
        inliers.xy_px,
        residuals_px,
        z=z,
        size_px=(row["width"], row["height"]) if row["width"] else None,
        centre_px=principal_point(row),
        sigma_px=row["sigma_constant_px"],
    )
