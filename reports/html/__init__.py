"""The report: one HTML file that works without a network (docs/report.md). Needs the extra ``report``."""

from __future__ import annotations

from sfm_audit.reports.html.content import MAX_ROWS, RunContent, read_content
from sfm_audit.reports.html.page import PageInput, render_page
from sfm_audit.reports.html.pictures import ImagePictures, Picture, draw_camera_field, draw_image
from sfm_audit.reports.html.scenes import ModelView, chosen_models
from sfm_audit.reports.html.statements import Statements, witnesses_of

__all__ = [
    "MAX_ROWS",
    "ImagePictures",
    "ModelView",
    "PageInput",
    "Picture",
    "RunContent",
    "Statements",
    "chosen_models",
    "draw_camera_field",
    "draw_image",
    "read_content",
    "render_page",
    "witnesses_of",
]
