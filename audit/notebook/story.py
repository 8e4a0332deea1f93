"""One image's story as text, from its auditor and its row of the images table. Needs no matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.misfit import MisfitGroup, prepare_image
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports.text.explain import Story, render_story, strongest_where


def explained_field(auditor: ModelAuditor, image_idx: int, row: Mapping[str, Any]) -> FloatArray | None:
    """Return what the named misfit explains of the residuals (n, 2), px, on the model as it stands; None without one.

    row: of the table ``images``
    """
    camera = auditor.model.image(image_idx).camera
    if camera is None or row["misfit_group"] is None:
        return None
    residuals_px = auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)]
    prepared = prepare_image(camera, xyz_cam_of(auditor, image_idx))
    field_px = prepared.explained_px(residuals_px, MisfitGroup(row["misfit_group"]))
    return field_px.T if np.isfinite(field_px).all() else None


def xyz_cam_of(auditor: ModelAuditor, image_idx: int) -> FloatArray:
    """Return the image's inliers (n, 3) in its camera frame, model units."""
    return auditor.model.image(image_idx).cam_from_world(auditor.inliers(image_idx).xyz_world)


def story_of(
    auditor: ModelAuditor, image_idx: int, row: Mapping[str, Any], model_row: Mapping[str, Any], width: int = 100
) -> str:
    """Return the whole story of the image in row ``image_idx``; its row of ``images``, its model's of ``models``."""
    field_px = explained_field(auditor, image_idx, row)
    where = None
    if field_px is not None:
        where = strongest_where(auditor.inliers(image_idx).xy_px, field_px, (row["width"], row["height"]))
    story = Story(row, auditor.config.model_dump(), auditor.model.location, where, {}, model=model_row)
    return render_story(story, width)
