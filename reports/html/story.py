"""One image's story as a page of its own: what ``explain`` writes beside its text where photos are given."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from typing import Any, Final

from sfm_audit.reports.charts import CAPTIONS, Residuals, sensor
from sfm_audit.reports.html.page import environment
from sfm_audit.reports.html.pictures import Picture
from sfm_audit.reports.text.wording import plain

_NO_PHOTO: Final = "No photo of this name in the folder of --images."
_NO_RESIDUALS: Final = "No inliers to show on the photo: neither the run nor its model has them."


def render_story_page(
    row: Mapping[str, Any],
    text: str,
    pictures: Iterable[tuple[str, bytes]],
    residuals: Residuals | None,
    photo_url: str | None,
) -> str:
    """Return the page: one HTML document that asks for nothing outside itself.

    Parameters
    ----------
    row : of ``RUN/images``            text : the story            pictures : what each shows, PNG
    residuals : None where nobody has them            photo_url : the photo as a data URL, None where there is none
    """
    photo = None
    if photo_url is not None and residuals is not None:
        photo = Picture(CAPTIONS["inliers_on_photo"], sensor.inliers_on_photo(residuals, photo_url))
    return (
        environment()
        .get_template("story.html.j2")
        .render(
            name=plain(row["image_name"]),
            verdict=row["verdict"],
            text=text,
            photo=photo,
            missing=_NO_PHOTO if photo_url is None else _NO_RESIDUALS,
            pictures=[(caption, _data_url(content)) for caption, content in pictures],
        )
    )


def _data_url(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
