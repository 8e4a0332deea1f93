"""Where is the photo of an image, and what does it look like, small? Never outside the folder the user named."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_LONGER_SIDE: Final = 900
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


def read_photo(path: Path) -> NDArray[Any] | None:
    """Return a photo as (rows, columns, 3), at most 900 px long, not turned, as COLMAP reads it; None if unreadable."""
    try:
        with Image.open(path) as photo:
            if photo.width * photo.height > _MAX_PIXELS:
                return None
            photo.draft("RGB", (_LONGER_SIDE, _LONGER_SIDE))
            small = photo.convert("RGB")
        small.thumbnail((_LONGER_SIDE, _LONGER_SIDE))
        return np.asarray(small)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
