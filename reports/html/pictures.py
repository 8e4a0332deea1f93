"""Which pictures does an image get on the page? All of its residuals, and its photo where there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup
from numpy.typing import NDArray

from sfm_audit.reports import figures
from sfm_audit.reports.figures import CAPTIONS
from sfm_audit.reports.html.svg import to_jpeg_url, to_svg


@dataclass(frozen=True, slots=True)
class Picture:
    """An inline SVG, or the data URL of a photo; one of the two is None. caption: what it shows, how to read it."""

    caption: str
    svg: Markup | None = None
    url: str | None = None


@dataclass(frozen=True, slots=True)
class ImagePictures:
    """The pictures of one image; ``missing`` says why there are none, or why one is not there."""

    pictures: Sequence[Picture] = ()
    missing: str | None = None


def draw_image(
    key: str,
    residuals: figures.Residuals,
    row: Mapping[str, Any],
    *,
    photo: NDArray[Any] | None,
    tau_px: float | None,
    alpha: float,
    missing: str | None = None,
) -> ImagePictures:
    """Draw all pictures of one image; ``key`` is unique on the page."""
    drawn = {
        "residual_vectors": figures.residual_vectors(residuals),
        "residual_field": figures.residual_field(residuals),
        "radial_profile": figures.radial_profile(residuals),
        "misfit_groups": figures.misfit_groups(row, tau_px=tau_px, alpha=alpha),
        "standardised_histogram": figures.standardised_histogram(residuals),
        "qq_plot": figures.qq_plot(residuals),
        "scale_comparison": figures.scale_comparison(residuals),
    }
    pictures = [
        Picture(CAPTIONS[name], svg=to_svg(figure, key=f"{key}-{name}", label=CAPTIONS[name]))
        for name, figure in drawn.items()
    ]
    if photo is not None:
        url = to_jpeg_url(figures.inliers_on_photo(residuals, photo))
        pictures.insert(0, Picture(CAPTIONS["inliers_on_photo"], url=url))
    return ImagePictures(pictures, missing)
