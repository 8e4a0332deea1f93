"""The report: one HTML file that works without a network (docs/report.md). Needs the extra ``report``."""

from __future__ import annotations

from reports.html.content import MAX_ROWS, RunContent, read_content
from reports.html.page import PageInput, render_page
from reports.html.pictures import ImagePictures, Picture, draw_image

__all__ = [
    "MAX_ROWS",
    "ImagePictures",
    "PageInput",
    "Picture",
    "RunContent",
    "draw_image",
    "read_content",
    "render_page",
]
