"""How many images has a model? Read from the head of its files, or counted; no model is loaded."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.formats import format_of
from sfm_audit.loaders.paths.locations import parse_location

_AT_ONCE = 16  # an object store takes its time to answer


def count_images(location: str) -> int:
    """Return the number of images that the model in the folder ``location`` says it has.

    Raises
    ------
    LoadError
        Files are missing, cannot be read, or are smaller than that number of images.
    """
    folder = parse_location(location)
    return format_of(folder).count_images(folder)


def count_images_of(locations: Iterable[str]) -> list[int | LoadError]:
    """Return the number of images of each model, or why it cannot be told."""

    def count(location: str) -> int | LoadError:
        try:
            return count_images(location)
        except LoadError as error:
            return error

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return list(pool.map(count, locations))
