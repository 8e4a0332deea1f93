"""Which pictures does an image or a camera get on the page? All of its residuals, and its photo where there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from markupsafe import Markup

from sfm_audit.reports.charts import CAPTIONS, Residuals, cameras, normality, sensor

_FIELD_CELLS: Final = (8, 24)  # along the longer side of a camera's field
_PER_CELL: Final = 40  # observations that a cell of a camera's field should have


@dataclass(frozen=True, slots=True)
class Picture:
    """An inline SVG. caption: what it shows, how to read it."""

    caption: str
    svg: Markup


@dataclass(frozen=True, slots=True)
class ImagePictures:
    """The pictures of one image; ``missing`` says why there are none, or why one is not there."""

    pictures: Sequence[Picture] = ()
    missing: str | None = None


def draw_image(
    residuals: Residuals,
    row: Mapping[str, Any],
    *,
    photo_url: str | None,
    tau_px: float | None,
    alpha: float,
    missing: str | None = None,
) -> ImagePictures:
    """Draw all pictures of one image; ``photo_url``: its photo as a data URL."""
    groups = CAPTIONS["misfit_groups"]
    drawn = {
        "residual_vectors": sensor.residual_vectors(residuals),
        "residual_field": sensor.residual_field(residuals),
        "radial_profile": sensor.radial_profile(residuals),
        "misfit_groups": cameras.misfit_groups(row, tau_px=tau_px, alpha=alpha, label=groups),
        "standardised_histogram": normality.standardised_histogram(residuals),
        "qq_plot": normality.qq_plot(residuals),
        "scale_comparison": normality.scale_comparison(residuals),
    }
    if photo_url is not None:
        drawn = {"inliers_on_photo": sensor.inliers_on_photo(residuals, photo_url), **drawn}
    return ImagePictures([Picture(CAPTIONS[name], svg) for name, svg in drawn.items()], missing)


def draw_camera_field(residuals: Residuals, camera_id: int) -> Picture:
    """Draw the mean residuals of all images of a camera over its sensor."""
    wanted = round((max(len(residuals), 1) / _PER_CELL) ** 0.5)
    cells = min(max(wanted, _FIELD_CELLS[0]), _FIELD_CELLS[1])
    label = f"Mean residuals over the sensor of camera {camera_id}, all its images together"
    return Picture(CAPTIONS["camera_field"], sensor.residual_field(residuals, cells=cells, label=label))
