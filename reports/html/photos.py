"""Where is the photo of an image, and what does it look like, small? Never outside the folder the user named."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from PIL import Image

THUMBNAIL: Final = 112  # px, the longer side
PHOTO: Final = 900
_MAX_PIXELS: Final = 400_000_000  # a file that unpacks to more is no photo


def find_photo(folder: Path, row: Mapping[str, Any]) -> Path | None:
    """Return the file of an image below ``folder``: under its name, or in the folders of its scene; None without.

    A name that leads out of the folder (``../``, an absolute path) finds nothing, and a link that does neither: to see
    such photos, name the folder that the links lead to.
    """
    name, scene = str(row["image_name"]), str(row["scene"])
    for below in ("", f"{scene}/images", scene, f"{scene}/dense/images"):
        relative = os.path.normpath(Path(below) / name)
        if Path(relative).is_absolute() or relative.split(os.sep, 1)[0] == os.pardir or "\0" in relative:
            continue
        try:
            found = folder / relative
            if found.is_file() and found.resolve().is_relative_to(folder.resolve()):
                return found
        except OSError:  # a name that is too long for this file system
            continue
    return None


def photo_urls(path: Path, *longer_sides: int) -> list[str] | None:
    """Return a photo as JPEG data URLs, one per size, the largest first; not turned, as COLMAP reads it.

    Nothing but pixels of the file is passed on. None where it cannot be read.
    """
    try:
        with Image.open(path) as photo:
            if photo.width * photo.height > _MAX_PIXELS:
                return None
            photo.draft("RGB", (longer_sides[0], longer_sides[0]))
            small = photo.convert("RGB")
        return [_url(small, side) for side in longer_sides]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def _url(photo: Image.Image, side: int) -> str:
    photo.thumbnail((side, side))
    content = BytesIO()
    photo.save(content, format="jpeg", quality=80 if side > THUMBNAIL else 60, optimize=True, exif=b"")
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"
