"""One image's whole story for ``sfm-audit explain``: audited within its model, told and drawn. Imports matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from sfm_audit.audit.camera_quality.expected_error import expected_error_map, median_depth
from sfm_audit.audit.cli.recompute import ResidualSource, tau_px
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.notebook.residuals import image_residuals_of
from sfm_audit.audit.notebook.story import explained_field, xyz_cam_of
from sfm_audit.audit.table import ModelLabels
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.reports import figures
from sfm_audit.reports.charts import CAPTIONS, ResidualError, Residuals
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.text.explain import Story, render_story, strongest_where
from sfm_audit.reports.text.wording import plain


@dataclass(frozen=True, slots=True, eq=False)
class ToldImage:
    """The story as text, and its pictures: file name -> content, and what each shows.

    row: of ``RUN/images``.    residuals: None where neither run nor model has them.
    """

    row: Mapping[str, Any]
    text: str
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    captions: Mapping[str, str] = field(default_factory=dict)
    residuals: Residuals | None = None


def tell(auditor: ModelAuditor, image_idx: int) -> ToldImage:
    """Audit a model, and tell the story of the image in row ``image_idx``."""
    with threadpool_limits(limits=1, user_api="blas"):
        row, model = _rows(auditor, image_idx)
    return _told_with_model(auditor, image_idx, Story(row, auditor.config.model_dump(), "", None, {}, model=model))


def tell_from_run(run: RunReader, row: Mapping[str, Any]) -> ToldImage:
    """Tell the story of the image in a row of ``RUN/images`` that knows its ``part``; nothing is audited again.

    Pictures are drawn from the model where it lies as the run read it, else from RUN/observations, else not at all.
    """
    source, again = ResidualSource(run), run.info.get("decided_again")
    story = Story(row, run.info["config"], row["model_path"], None, {}, again, _model_row(run, row))
    try:
        auditor = source.auditor(row["model_path"])
    except ResidualError as error:
        problem = str(error)
    else:
        found = np.flatnonzero(auditor.model.images.image_id == row["image_id"])
        if len(found):
            return _told_with_model(auditor, int(found[0]), story)
        problem = f"{row['model_path']}: holds no image of id {row['image_id']} any more"
    if not run.has_part("observations", row["part"]):
        return ToldImage(row, f"{render_story(story)}\nNo pictures: {plain(problem)}\n")
    residuals = source.residuals(row)
    return _told(story, _figures(story, residuals, None, None), residuals)


def _told_with_model(auditor: ModelAuditor, image_idx: int, story: Story) -> ToldImage:
    row = story.row
    with threadpool_limits(limits=1, user_api="blas"):
        residuals = image_residuals_of(auditor, image_idx, row)
        field_px = explained_field(auditor, image_idx, row)
        error_px = _expected_error(auditor, image_idx, row)
    drawn = _figures(story, residuals, field_px, error_px)
    where = None if field_px is None else strongest_where(residuals.xy_px, field_px, residuals.size_px)
    return _told(replace(story, location=auditor.model.location, where=where), drawn, residuals)


def _told(story: Story, drawn: Mapping[str, Figure], residuals: Residuals) -> ToldImage:
    names = {name: f"{number:02d}_{name}.png" for number, name in enumerate(drawn, 1)}
    captions = {names[name]: CAPTIONS[name] for name in drawn}
    pictures = {names[name]: _png(figure) for name, figure in drawn.items()}
    return ToldImage(story.row, render_story(replace(story, pictures=captions)), pictures, captions, residuals)


def _rows(auditor: ModelAuditor, image_idx: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """The rows of the image and of its model: q-values and findings need all images."""
    tables = auditor.tables(ModelLabels("", "", "0", auditor.model.location))
    return tables.images.slice(image_idx, 1).to_pylist()[0], tables.models.to_pylist()[0]


def _model_row(run: RunReader, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the row of ``RUN/models`` of the image's model."""
    rows = run.rows("models", ("model_path", "num_images", "findings"))
    return next((each for each in rows if each["model_path"] == row["model_path"]), None)


def _expected_error(auditor: ModelAuditor, image_idx: int, row: Mapping[str, Any]) -> FloatArray | None:
    """Expected measurement error over the image, px; None without a camera or with too little to tell."""
    camera, sigma_px = auditor.model.image(image_idx).camera, row["sigma_constant_px"]
    if camera is None or row["expected_error_px"] is None:
        return None
    quality, xyz_cam = auditor.quality[image_idx], xyz_cam_of(auditor, image_idx)
    if quality is None:
        return None
    depth = median_depth(camera, xyz_cam)
    return expected_error_map(camera, quality.identifiability.parameters, sigma_px, depth).error_px


def _figures(
    story: Story, residuals: Residuals, field_px: FloatArray | None, error_px: FloatArray | None
) -> dict[str, Figure]:
    row, config = story.row, story.config
    drawn = {
        "residual_vectors": figures.residual_vectors(residuals),
        "residual_field": figures.residual_field(residuals),
        "radial_profile": figures.radial_profile(residuals),
        "misfit_groups": figures.misfit_groups(
            row, tau_px=tau_px(config, row["sigma_constant_px"]), alpha=config["alpha"]
        ),
        "standardised_histogram": figures.standardised_histogram(residuals),
        "qq_plot": figures.qq_plot(residuals),
        "scale_comparison": figures.scale_comparison(residuals),
    }
    if field_px is not None:
        what = f"vectors of the {str(row['misfit_group']).replace('_', ' ')} field"
        field = figures.residual_vectors(residuals.replaced(field_px), what=what)
        drawn = {"residual_vectors": drawn.pop("residual_vectors"), "explained_field": field, **drawn}
    if error_px is not None:
        drawn["expected_error"] = figures.expected_error(error_px, residuals.size_px)
    return drawn


def _png(figure: Figure) -> bytes:
    content = BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()
