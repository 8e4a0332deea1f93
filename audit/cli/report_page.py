"""The page of ``sfm-audit report``: run folder, residuals and photos brought together. Imports matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
from tqdm import tqdm

from sfm_audit.audit.cli.recompute import ResidualSource, tau_px
from sfm_audit.reports import html
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.figures import ResidualError
from sfm_audit.reports.html.photos import find_photo, read_photo
from sfm_audit.reports.run_folder.reader import Row, RunReader
from sfm_audit.reports.text.wording import plain


@dataclass(frozen=True, slots=True)
class Made:
    """The page, and what is on it."""

    text: str
    num_images: int
    num_drawn: int


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
    source = ResidualSource(run, named)
    rows = content.rows[:worst]
    pictures = [html.ImagePictures()] * len(rows)
    # models are opened one after the other, each once, whatever the order of the images on the page
    for i in tqdm(sorted(range(len(rows)), key=lambda i: rows[i]["model_path"]), unit="image", disable=silent):
        pictures[i] = _pictures(f"worst-{i}", rows[i], source, photos, content)
    no_photos = None if photos else "Name the folder of the photos with --images to see the inliers on them."
    text = html.render_page(html.PageInput(content, pictures, no_photos))
    return Made(text, content.num_images, sum(bool(item.pictures) for item in pictures))


def _pictures(
    key: str, row: Row, source: ResidualSource, photos: Path | None, content: html.RunContent
) -> html.ImagePictures:
    try:
        residuals = source.residuals(row)
    except ResidualError as error:
        return html.ImagePictures(missing=f"No pictures: {plain(str(error))}.")
    path = find_photo(photos, row) if photos else None
    photo = read_photo(path) if path else None
    return html.draw_image(
        key,
        residuals,
        row,
        photo=photo,
        tau_px=tau_px(content.config, row["sigma_constant_px"]),
        alpha=float(content.config.get("alpha", 0.05)),
        missing="No photo of this name in the folder of --images." if photos and photo is None else None,
    )
