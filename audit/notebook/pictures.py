"""One image's residuals as the figures take them, and in axes of the user's. Imports matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from threadpoolctl import threadpool_limits

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.reports.figures import Residuals, draw_residual_vectors
from sfm_audit.reports.figures.residuals import principal_point


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


def plot_residuals(residuals: Residuals, ax: Axes | None, title: str, magnify: float | None) -> Axes:
    """Draw the residuals as arrows into ``ax``, or into new axes of pyplot's, which a notebook shows."""
    axes = ax if ax is not None else _new_axes()
    draw_residual_vectors(axes, residuals, magnify=magnify)
    axes.set_title(f"{title}\n{axes.get_title()}".rstrip())
    return axes


def _new_axes() -> Axes:
    from matplotlib import pyplot as plt  # noqa: PLC0415 - the command line draws without it

    return plt.subplots(layout="constrained")[1]
