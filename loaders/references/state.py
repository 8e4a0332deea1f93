"""Did what a run names besides its models change? Names, sizes and content of databases, references and priors."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

from sfm_audit.loaders.colmap.database import find_database
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.evidence import NotAsked
from sfm_audit.loaders.formats import model_file_names
from sfm_audit.loaders.paths.files import is_folder, listing_of, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath, RemotePath, parse_location
from sfm_audit.loaders.references.formats import IMAGES_TXT, place_of_reference
from sfm_audit.loaders.references.positions import AUTO
from sfm_audit.loaders.references.trajectories import sensor_file

LARGE_BYTES: Final = 1 << 28
"""Of larger files size and time of change count; smaller ones are read."""


def evidence_state(location: str, below: str, database: str | None, reference: str | None, priors: str | None) -> str:
    """Return what the evidence of one model is at the moment, as one string; empty where none was named.

    Parameters
    ----------
    location, below : of the model (`loaders.datasets.discover.ModelRef`)
    database, reference, priors : as the settings name them

    Notes
    -----
    What cannot be read is said so in the string: the audit itself says what is wrong.
    """
    parts = []
    for kind, files in (
        ("database", _database(database, location)),
        ("reference", _reference(reference, below)),
        ("priors", _database(priors, location)),
    ):
        try:
            parts += [f"{kind}:{_state(path)}" for path in files]
        except (LoadError, OSError):
            parts.append(f"{kind}:unreadable")
    return hashlib.sha256(" ".join(parts).encode(errors="surrogateescape")).hexdigest() if parts else ""


def _database(named: str | None, location: str) -> Iterator[InputPath | None]:
    if named is not None:
        yield find_database(location) if named == AUTO else parse_location(named)


def _reference(named: str | None, below: str) -> Iterator[InputPath | None]:
    if named is None:
        return
    place = place_of_reference(named, below)
    if isinstance(place, NotAsked):
        yield None
    elif is_folder(place):
        yield from (place / name for name in sorted({*model_file_names(place), *_own_images(place)}))
    else:
        yield place
        if isinstance(place, Path) and sensor_file(place).is_file():
            yield sensor_file(place)


def _own_images(folder: InputPath) -> tuple[str, ...]:
    names = listing_of(folder) if isinstance(folder, RemotePath) else [path.name for path in folder.iterdir()]
    return (IMAGES_TXT,) if IMAGES_TXT in names else ()


def _state(path: InputPath | None) -> str:
    if path is None:
        return "none"
    if isinstance(path, RemotePath):
        from sfm_audit.loaders.paths.remote import entity_tag  # noqa: PLC0415 - pyarrow costs what others need not pay

        return f"{path}:{entity_tag(path)}"
    if path.is_dir():
        return f"{path}:folder"
    stat = path.stat()
    content = str(stat.st_mtime_ns) if stat.st_size > LARGE_BYTES else _hashed(path, stat.st_size, stat.st_mtime_ns)
    return f"{path.absolute()}:{stat.st_size}:{content}"


@lru_cache(maxsize=1024)
def _hashed(path: Path, size: int, mtime_ns: int) -> str:
    """Return the SHA-256 of a file; the same for many models of a run. size, mtime_ns: of the file, for the cache."""
    del size, mtime_ns
    file, _ = open_input(path, may_be_empty=True)
    with file, reading(path):
        return hashlib.file_digest(file, "sha256").hexdigest()
