"""Keypoint scales and orientations from COLMAP's database.db, for the observations of a model.

Tables read (COLMAP 4.2, src/colmap/scene/database_sqlite.cc): ``images`` (image_id, name) and ``keypoints`` (image_id,
rows, cols, data), data = rows x cols float32, row-major, little-endian.
"""

from __future__ import annotations

import os
import posixpath
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.colmap.sqlite_guard import open_database
from sfm_audit.loaders.errors import (
    LoadError,
    MalformedFileError,
    MissingFileError,
    TruncatedFileError,
    UnreadableFileError,
)
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.files import exists, open_input
from sfm_audit.loaders.paths.locations import RemotePath, parse_location

DATABASE_NAME: Final = "database.db"
_LEVELS_UP: Final = 3
_MAGIC: Final = b"SQLite format 3\0"
_HEADER_BYTES: Final = 100
OTHER_DATABASE: Final = "give the database that this model was made from, or do without it"

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class KeypointShapes:
    """Scale and orientation of each linked 2D point; row i of every array is row i of ``SparseModel.observations``.

    location: the database.    scale_px: (M,) px, as COLMAP's ``FeatureKeypoint::ComputeScale``.
    orientation_rad: (M,) rad, as its ``ComputeOrientation``.    Both NaN where the database stores positions only.
    """

    location: str
    scale_px: FloatArray
    orientation_rad: FloatArray


def find_database(model_location: str | Path) -> Path | None:
    """Return the ``database.db`` beside a model or at most three folders above it, the nearest one; None without.

    MegaDepth keeps it in ``<scene>/`` and its models in ``<scene>/sparse/manhattan/<k>/``: three folders above.

    Raises
    ------
    UnreadableFileError
        The model lies in an object store: SQLite reads files of this machine.
    """
    folder = parse_location(model_location)
    if isinstance(folder, RemotePath):
        wanted, advice = "a model on this machine, for its database.db", "copy the scene, or use --noise track"
        raise UnreadableFileError(str(folder), None, wanted, "one in an object store", advice)
    folder = folder.absolute()
    for candidate in (folder, *folder.parents[:_LEVELS_UP]):
        path = candidate / DATABASE_NAME
        if exists(path):
            return path
    return None


def name_of_database(path: Path, model_location: str, below: str) -> str:
    """Return how findings call the database of a model, with slashes.

    Parameters
    ----------
    path : of `find_database`            below : the path of the model below what the user gave; the name begins there,
        or at the model where that was given
    """
    return posixpath.normpath(posixpath.join(below, Path(os.path.relpath(path, model_location)).as_posix()))


def database_of(model_location: str, shown_as: str, below: str, option: str) -> tuple[Path, str]:
    """Return the database that belongs to a model, and how findings call it.

    Parameters
    ----------
    shown_as : how errors call the model    below : see `name_of_database`    option : that would name another one

    Raises
    ------
    MissingFileError
        There is none.
    UnreadableFileError
        See `find_database`.
    """
    path = find_database(model_location)
    if path is None:
        wanted = "a database.db beside the model or up to three folders above it"
        raise MissingFileError(shown_as, None, wanted, "none", f"name it with {option}")
    return path, name_of_database(path, model_location, below)


def read_keypoint_shapes(path: str | Path, model: SparseModel) -> KeypointShapes:
    """Read the keypoint scales of a model's observations from the database it was made from.

    Parameters
    ----------
    path : the SQLite file, opened read-only; nothing is written, not even a lock
    model : its images are looked up by *name* and their 2D points by position: image ids of database and model may
        differ (models that were merged, renumbered or exported), names and the order of POINTS2D do not

    Returns
    -------
    KeypointShapes
        NaN for images whose keypoints have two columns (positions only, as learned features are often stored).

    Raises
    ------
    LoadError
        MissingFileError, LfsPointerError, UnreadableFileError, TruncatedFileError as for every input;
        MalformedFileError where the file is no SQLite database, lacks the tables, or a blob's size disagrees with its
        rows and columns; LoadError where an image of the model is not in it, or has another number of keypoints.

    Notes
    -----
    Two columns: x, y. Four: x, y, scale, orientation. Six: x, y, a11, a12, a21, a22, then
    scale = (|(a11, a21)| + |(a12, a22)|) / 2 and orientation = atan2(a21, a11)
    (COLMAP 4.2, src/colmap/feature/types.cc).
    """
    path = Path(path)
    check_database(path)
    images, observations = model.images, model.observations
    scale = np.full(len(observations), np.nan)
    orientation = np.full(len(observations), np.nan)
    with closing(asked(path, lambda: open_database(path))) as db:
        rows_of = asked(path, lambda: rows_by_name(path, db, frozenset(images.name)))
        for image_idx, name in enumerate(images.name):
            keypoints = stored_keypoints(path, db, (name, rows_of.get(name)), int(images.num_points2d[image_idx]))
            rows = slice(*observations.offsets[image_idx : image_idx + 2])
            with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
                linked = keypoints[observations.point2d_idx[rows], 2:].astype(np.float64)
            scale[rows], orientation[rows] = _shape_of(linked)
    return KeypointShapes(str(path), scale, orientation)


def read_keypoint_scales(model: SparseModel, shown_as: str) -> FloatArray:
    """Return (M,) keypoint sizes, px, of a model's observations, from the database beside or above the model.

    Raises
    ------
    LoadError
        There is no database, it cannot be read, or it stores positions only; ``shown_as`` names the model.
    """
    database = find_database(model.location)
    if database is None:
        raise MissingFileError(
            shown_as,
            None,
            "a database.db beside the model or up to three folders above it, for --noise keypoint",
            "none",
            "put it there, or use --noise track",
        )
    scale_px = read_keypoint_shapes(database, model).scale_px
    if scale_px.size and np.isnan(scale_px).all():
        advice = "use --noise track with these features"
        raise MalformedFileError(str(database), None, "keypoints with a scale", "positions only", advice)
    return scale_px


def _shape_of(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale, px, and orientation, rad, (m,) each, from the columns after x and y: none, two or four."""
    if columns.shape[1] == 0:
        unknown = np.full(len(columns), np.nan)
        return unknown, unknown
    if columns.shape[1] == 2:
        return columns[:, 0], columns[:, 1]
    a11, a12, a21, a22 = columns.T
    return 0.5 * (np.hypot(a11, a21) + np.hypot(a12, a22)), np.arctan2(a21, a11)


StoredRows = tuple[int, int | None]
"""Id of an image, and the row of its keypoints, None where it has none."""


def rows_by_name(path: Path, db: sqlite3.Connection, wanted: frozenset[str]) -> dict[str, StoredRows]:
    """Return id and keypoint row of the images of the given names.

    Raises
    ------
    MalformedFileError
        Two images have one of the names, or two rows of keypoints belong to one image.
    """
    ids: dict[str, int] = {}
    for image_id, name in db.execute("SELECT image_id, name FROM images"):
        if not isinstance(name, str) or name not in wanted:
            continue
        if not isinstance(image_id, int):
            raise malformed(path, f"an id of the image {name!r}", f"{image_id!r:.40}")
        if name in ids:
            raise malformed(path, f"one image called {name!r}", f"images {ids[name]} and {image_id}")
        ids[name] = image_id
    names = {image_id: name for name, image_id in ids.items()}
    keypoints: dict[int, int] = {}
    for row, image_id in db.execute("SELECT rowid, image_id FROM keypoints"):
        if image_id not in names:
            continue
        if image_id in keypoints:
            raise malformed(path, f"one row of keypoints for image {image_id} ({names[image_id]!r})", "two")
        keypoints[image_id] = row
    return {name: (image_id, keypoints.get(image_id)) for name, image_id in ids.items()}


def stored_keypoints(
    path: Path, db: sqlite3.Connection, image: tuple[str, StoredRows | None], num_points2d: int
) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Return the (num_points2d, 2 | 4 | 6) keypoints of an image: its name, and its rows in the database."""
    name, found = image
    if found is None:
        raise LoadError(str(path), None, f"the image {name!r} of the model", "no image of that name", OTHER_DATABASE)
    image_id, row = found
    rows, cols, data = 0, 2, b""
    if row is not None:  # else the image has no row in the table of keypoints
        query = "SELECT rows, cols, data FROM keypoints WHERE rowid = ?"
        stored = asked(path, lambda: db.execute(query, (row,)).fetchone())
        if stored is None:  # a damaged table: a walk finds the row, a search does not
            raise malformed(path, f"the keypoints of image {image_id} ({name!r}) in row {row}", "no such row")
        rows, cols, data = stored
    where = f"keypoints of image {image_id} ({name!r})"
    if not (isinstance(rows, int) and isinstance(cols, int) and rows >= 0 and cols in {2, 4, 6}):
        raise malformed(path, f"{where} with 2, 4 or 6 columns", f"{rows!r:.40} rows and {cols!r:.40} columns")
    data = data or b""
    if not isinstance(data, bytes) or len(data) != rows * cols * 4:
        got = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
        raise malformed(path, f"{where} in {rows * cols * 4} bytes ({rows} x {cols} float32)", got)
    if rows != num_points2d:
        raise LoadError(str(path), None, f"{num_points2d} {where}, as in the model", f"{rows}", OTHER_DATABASE)
    return np.frombuffer(data, dtype="<f4").reshape(rows, cols)


def check_database(path: Path) -> None:
    """Raise unless ``path`` is a whole SQLite database that nobody is writing to.

    A database cut short opens without complaint and fails only where a page is missing, so its size is compared with
    the header's (https://www.sqlite.org/fileformat.html#the_database_header).
    """
    file, size = open_input(path)
    with file:
        header = file.read(_HEADER_BYTES)
    if header[: len(_MAGIC)] != _MAGIC[: len(header)]:
        raise malformed(path, "a SQLite database", f"a file that starts with {header[:16]!r}")
    page_bytes = int.from_bytes(header[16:18], "big")
    page_bytes = 65536 if page_bytes == 1 else page_bytes
    wanted = max(_HEADER_BYTES, page_bytes * int.from_bytes(header[28:32], "big"))
    if size < wanted:
        raise TruncatedFileError(str(path), None, f"{wanted} bytes, as its header says", f"{size}", "copy it again")
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:  # an immutable connection would not see what is in there
        advice = "end the program that has the database open, or open it once with sqlite3 to take the log in"
        raise UnreadableFileError(str(path), None, "a database that is not in use", f"changes in {log.name}", advice)


def asked(path: Path, question: Callable[[], T], wanted: str = "COLMAP's tables of images and keypoints") -> T:
    """Return the answer of SQLite; its errors, and text that is not UTF-8, become a LoadError."""
    try:
        return question()
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise malformed(path, wanted, str(error)) from error


def malformed(path: Path, wanted: str, got: str) -> MalformedFileError:
    """Return the error of a database that is not as COLMAP writes it."""
    return MalformedFileError(str(path), None, wanted, got, "export the database again, or do without it")
