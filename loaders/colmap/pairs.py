"""Verified inlier matches of image pairs from COLMAP's database.db, pair by pair, for the images of a model.

Table read besides those of keypoints: ``two_view_geometries`` (pair_id, rows, cols, data, config), data = rows x 2
uint32, row-major, little-endian; pair_id = 2147483647 * smaller image id + larger image id, old schema and new (COLMAP
4.2, src/colmap/scene/database_sqlite.cc; config: TwoViewGeometry::ConfigurationType).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, UInt32Array
from sfm_audit.loaders.colmap.database import (
    OTHER_DATABASE,
    StoredRows,
    asked,
    check_database,
    database_of,
    malformed,
    rows_by_name,
    stored_keypoints,
)
from sfm_audit.loaders.colmap.sqlite_guard import PAIR_TABLES, open_database
from sfm_audit.loaders.errors import LoadError, called
from sfm_audit.loaders.model import MatchedPair, PairSource, SparseModel

AUTO: Final = "auto"
MAX_IMAGES: Final = 2147483647
GEOMETRIES: Final = frozenset({2, 3, 4, 5, 6, 9})
"""One motion between two images: calibrated, uncalibrated, planar, panoramic, either of the two, calibrated rig. Not:
undefined, degenerate, watermark, several motions."""
MAX_SHIFT_PX: Final = 2.0
"""Median distance between an image's 2D points in model and database above which the database is another one's."""


class DatabasePairs:
    """The verified pairs of a database whose two images a model has (`loaders.model.PairSource`).

    Parameters
    ----------
    path : the SQLite file, opened read-only, for each question anew
    model : its images are looked up by name, their 2D points by position, as `read_keypoint_shapes` does

    Raises
    ------
    LoadError
        It cannot be read, or lacks an image of the model.
    """

    def __init__(self, path: str | Path, model: SparseModel) -> None:
        self._path, self._model = Path(path), model
        self._db: sqlite3.Connection | None = None
        check_database(self._path)
        with closing(self._open()) as db:
            self._rows: dict[str, StoredRows] = asked(
                self._path, lambda: rows_by_name(self._path, db, frozenset(model.images.name))
            )
        lost = next((name for name in model.images.name if name not in self._rows), None)
        if lost is not None:
            wanted, got = f"the image {lost!r} of the model", "no image of that name"
            raise LoadError(str(self._path), None, wanted, got, OTHER_DATABASE)
        self._image_idx = {self._rows[name][0]: i for i, name in enumerate(model.images.name)}

    @contextmanager
    def _kept_open(self, db: sqlite3.Connection) -> Iterator[None]:
        """While pairs are read, keypoints come by the same connection."""
        self._db = db
        try:
            yield
        finally:
            self._db = None

    def _open(self) -> sqlite3.Connection:
        return asked(self._path, lambda: open_database(self._path, PAIR_TABLES))

    def pairs(self) -> Iterator[MatchedPair]:
        """Go through the pairs with one motion, in the order of pair_id; matches are checked against the model's.

        Raises
        ------
        MalformedFileError
            A blob's size disagrees with its rows, a match names no 2D point, or pairs are not in order.
        """
        num_points2d = self._model.images.num_points2d
        with closing(self._open()) as db, self._kept_open(db):
            last = -1
            for pair_id, rows, cols, data, config in self._geometries(db):
                if not isinstance(pair_id, int) or pair_id <= last:
                    raise malformed(self._path, "pair_id in ascending order, each once", f"{pair_id!r:.40}")
                last = pair_id
                images = self._images_of(pair_id)
                if images is None or config not in GEOMETRIES or not rows:
                    continue
                matches = self._matches(pair_id, rows, cols, data)
                if (matches >= num_points2d[list(images)]).any():
                    raise malformed(self._path, f"2D points that images of pair {pair_id} have", f"{matches.max()}")
                yield MatchedPair(*images, matches)

    def _geometries(self, db: sqlite3.Connection) -> Iterator[tuple[object, ...]]:
        """Rows of the table; errors of SQLite become a LoadError."""
        query = "SELECT pair_id, rows, cols, data, config FROM two_view_geometries"
        cursor = asked(self._path, lambda: db.execute(query))
        while (row := asked(self._path, cursor.fetchone)) is not None:
            yield row

    def _images_of(self, pair_id: int) -> tuple[int, int] | None:
        """Rows of the two images; None where the model lacks one."""
        first, second = (self._image_idx.get(image_id) for image_id in divmod(pair_id, MAX_IMAGES))
        return None if first is None or second is None or first == second else (first, second)

    def _matches(self, pair_id: int, rows: object, cols: object, data: object) -> UInt32Array:
        where = f"matches of pair {pair_id}"
        if not (isinstance(rows, int) and rows >= 0 and cols == 2):
            raise malformed(self._path, f"{where} with 2 columns", f"{rows!r:.40} rows and {cols!r:.40} columns")
        if not isinstance(data, bytes) or len(data) != rows * 8:
            got = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
            raise malformed(self._path, f"{where} in {rows * 8} bytes ({rows} x 2 uint32)", got)
        return np.frombuffer(data, dtype="<u4").reshape(rows, 2)

    def keypoints_px(self, image_idx: int) -> FloatArray:
        """Return (num_points2d, 2) the 2D points of an image, px.

        Raises
        ------
        LoadError
            They cannot be read, or the model has them elsewhere: an undistorted copy, or another database.
        """
        images, observations = self._model.images, self._model.observations
        name = images.name[image_idx]
        with nullcontext(self._db) if self._db is not None else closing(self._open()) as db:
            stored = stored_keypoints(self._path, db, (name, self._rows[name]), int(images.num_points2d[image_idx]))
        xy_px = stored[:, :2].astype(np.float64)
        rows = slice(*observations.offsets[image_idx : image_idx + 2])
        shift = np.abs(xy_px[observations.point2d_idx[rows]] - observations.xy_px[rows]).max(axis=1, initial=0.0)
        if shift.size and not np.median(shift) <= MAX_SHIFT_PX:
            wanted, got = f"the 2D points of {name!r} where the model has them", f"{np.median(shift):.3g} px away"
            raise LoadError(str(self._path), None, wanted, got, f"{OTHER_DATABASE} (is the model undistorted?)")
        return xy_px


class RefusedPairs:
    """Pairs that cannot be asked, and why: every question raises the reason."""

    def __init__(self, reason: LoadError) -> None:
        self._reason = reason

    def pairs(self) -> Iterator[MatchedPair]:
        """Raise the reason."""
        raise self._reason

    def keypoints_px(self, image_idx: int) -> FloatArray:
        """Raise the reason."""
        del image_idx
        raise self._reason


class _PairsOfModel:
    """Those of the database that belongs to a model; errors call it by its place in the data set."""

    def __init__(self, source: PairSource, name: str) -> None:
        self._source, self._name = source, name

    def pairs(self) -> Iterator[MatchedPair]:
        """Go through the pairs."""
        with called(self._name):
            yield from self._source.pairs()

    def keypoints_px(self, image_idx: int) -> FloatArray:
        """Return (num_points2d, 2) the 2D points of an image, px."""
        with called(self._name):
            return self._source.keypoints_px(image_idx)


def database_pairs(model: SparseModel, database: str, shown_as: str, below: str = "") -> PairSource:
    """Return the verified pairs of a model.

    Parameters
    ----------
    database : its location, or ``auto``: the ``database.db`` beside the model or up to three folders above it
    shown_as : the model's location for messages            below : its path below what the user gave, with slashes

    Raises
    ------
    LoadError
        The named database cannot be read, or does not fit the model. With ``auto`` the pairs are refused instead.
    """
    if database != AUTO:
        return DatabasePairs(database, model)
    try:
        path, name = database_of(model.location, shown_as, below, "--database")
        with called(name):
            return _PairsOfModel(DatabasePairs(path, model), name)
    except LoadError as error:
        return RefusedPairs(error)
