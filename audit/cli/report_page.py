"""The page of ``sfm-audit report``: run folder, models and photos brought together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import pyarrow as pa
from tqdm import tqdm

from sfm_audit.audit.cli.model_source import scene_view
from sfm_audit.audit.cli.recompute import ResidualSource, tau_px
from sfm_audit.reports import html
from sfm_audit.reports.charts import ResidualError
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.html.photos import PHOTO, THUMBNAIL, find_photo, photo_urls
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.wording import plain

_MAX_FIELDS: Final = 12  # cameras whose residuals are drawn
_MAX_THUMBNAILS: Final = 100  # rows with a small photo


@dataclass(frozen=True, slots=True)
class Made:
    """The page, and what is on it.    num_wanted: photos that were looked for.    num_photos: photos that were found.

    example: the name of one of them, or nothing.
    """

    text: str
    num_images: int
    num_drawn: int
    num_wanted: int
    num_photos: int
    example: str


def make_page(run: RunReader, photos: Path | None, worst: int, named: Sequence[str] = (), *, silent: bool) -> Made:
    """Read a run, draw its worst images and return the page; ``named``: locations of models on the command line.

    Raises
    ------
    RunFolderError
        The tables cannot be read.
    """
    try:
        content = html.read_content(run)
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:  # a column or a word of another version
        what = f"its tables cannot be read ({' '.join(str(error).split())[:200]})"
        raise RunFolderError(run.folder, what, "audit again into a new folder") from error
    made = _Drawing(content, ResidualSource(run, named), photos)
    made.draw(worst, silent=silent)
    text = html.render_page(
        html.PageInput(
            content,
            [made.pictures[i] for i in range(len(made.pictures))],
            None if photos else "Name the folder of the photos with --images to see the inliers on them.",
            [made.thumbnails.get(i) for i in range(min(len(content.rows), _MAX_THUMBNAILS))] if photos else [],
            made.fields,
            [made.views[i] for i in range(len(made.views))],
        )
    )
    num_wanted = min(len(content.rows), max(worst, _MAX_THUMBNAILS)) if photos else 0
    return Made(
        text,
        content.num_images,
        sum(bool(item.pictures) for item in made.pictures.values()),
        num_wanted,
        len(made.thumbnails),
        str(content.rows[0]["image_name"]) if content.rows else "",
    )


class _Drawing:
    """What was drawn so far, by position on the page."""

    def __init__(self, content: html.RunContent, source: ResidualSource, photos: Path | None) -> None:
        self.pictures: dict[int, html.ImagePictures] = {}
        self.fields: dict[int, html.Picture | str] = {}
        self.views: dict[int, html.ModelView] = {}
        self.thumbnails: dict[int, str] = {}
        self._content, self._source, self._photos = content, source, photos

    def draw(self, worst: int, *, silent: bool) -> None:
        """Draw everything that needs a model or a photo; models are opened one after the other, each once."""
        rows, cameras = self._content.rows, self._content.cameras
        tasks: list[tuple[str, Callable[[], object]]] = []
        for i, (part, path, title) in enumerate(html.chosen_models(rows)):
            tasks.append((path, partial(self._view, i, part, path, title)))
        tasks += [(row["model_path"], partial(self._field, i, row)) for i, row in enumerate(cameras[:_MAX_FIELDS])]
        tasks += [(row["model_path"], partial(self._image, i, row)) for i, row in enumerate(rows[:worst])]
        if self._photos is not None:
            small = enumerate(rows[worst:_MAX_THUMBNAILS], start=worst)
            tasks += [(row["model_path"], partial(self._thumbnail, i, row)) for i, row in small]
        for _, task in tqdm(sorted(tasks, key=lambda item: item[0]), unit="drawing", disable=silent):
            task()

    def _view(self, i: int, part: str, path: str, title: str) -> None:
        try:
            self.views[i] = html.ModelView(part, title, scene_view(self._source.model(path)))
        except ResidualError as error:
            self.views[i] = html.ModelView(part, title, None, f"No view: {plain(str(error))}.")

    def _field(self, i: int, row: Row) -> None:
        try:
            self.fields[i] = html.draw_camera_field(self._source.pooled(row), row["camera_id"])
        except ResidualError as error:
            self.fields[i] = f"No residual field: {plain(str(error))}."

    def _image(self, i: int, row: Row) -> None:
        url = self._thumbnail(i, row, PHOTO)
        try:
            residuals = self._source.residuals(row)
        except ResidualError as error:
            self.pictures[i] = html.ImagePictures(missing=f"No pictures: {plain(str(error))}.")
            return
        self.pictures[i] = html.draw_image(
            residuals,
            row,
            photo_url=url,
            tau_px=tau_px(self._content.config, row["sigma_constant_px"]),
            alpha=float(self._content.config.get("alpha", 0.05)),
            missing="No photo of this name in the folder of --images." if self._photos and url is None else None,
        )

    def _thumbnail(self, i: int, row: Row, *larger: int) -> str | None:
        """Read the photo of a row, keep it small, and return it in the largest size."""
        path = find_photo(self._photos, row) if self._photos else None
        urls = photo_urls(path, *larger, THUMBNAIL) if path else None
        if urls is None:
            return None
        self.thumbnails[i] = urls[-1]
        return urls[0]
