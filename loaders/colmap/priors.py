"""Position priors from COLMAP's database.db, for the images of a model.

Table read besides images (COLMAP 4.2, src/colmap/scene/database_sqlite.cc; written by pycolmap 4.2.1): ``pose_priors``
(corr_data_id, corr_sensor_type, position, position_covariance, coordinate_system); before rigs (3.10 to 3.12)
``image_id`` in place of the first two. Position and covariance are 3 and 3 x 3 float64, NaN where not known; sensor
type 0 is a camera, its data id an image id. Coordinate system: -1 not said, 0 WGS84 (latitude and longitude in degrees,
altitude in m above the ellipsoid), 1 Cartesian; covariances are Cartesian (east, north, up in m with WGS84).
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.colmap.database import asked, check_database, malformed
from sfm_audit.loaders.colmap.sqlite_guard import PRIOR_TABLES, Tables, open_database

WGS84: Final = 0
CARTESIAN: Final = 1
NOT_SAID: Final = -1
_CAMERA: Final = 0
_WANTED: Final = "COLMAP's tables of images and pose_priors"


@dataclass(frozen=True, slots=True, eq=False)
class StoredPriors:
    """Priors by image name, as stored. position: (n, 3).    covariance: (n, 3, 3), NaN where not known.

    system: WGS84, CARTESIAN or NOT_SAID.
    """

    names: tuple[str, ...]
    position: FloatArray
    covariance: FloatArray
    system: int


def read_stored_priors(path: Path) -> StoredPriors:
    """Read the position priors of a database.

    Raises
    ------
    LoadError
        It cannot be read, a blob has another size, an image has two priors, or coordinate systems are mixed.
    """
    check_database(path)
    tables = asked(path, lambda: _tables_of(path), _WANTED)
    with closing(asked(path, lambda: open_database(path, tables))) as db:
        names = dict(asked(path, lambda: db.execute("SELECT image_id, name FROM images").fetchall()))
        columns = tables["pose_priors"]
        query = f"SELECT {', '.join(columns)} FROM pose_priors"  # noqa: S608 - two lists of names, both above
        rows = asked(path, lambda: db.execute(query).fetchall())
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    systems = set()
    for row in rows:
        stored = dict(zip(columns, row, strict=True))
        name = names.get(stored.get("image_id", stored.get("corr_data_id")))
        if stored.get("corr_sensor_type", _CAMERA) != _CAMERA or not isinstance(name, str):
            continue
        position = _numbers(path, stored["position"], 3, f"the position of {name!r}")
        if not np.isfinite(position).all():
            continue
        if name in found:
            raise malformed(path, f"one prior of the image {name!r}", "two")
        covariance = _numbers(path, stored.get("position_covariance"), 9, f"the covariance of {name!r}").reshape(3, 3)
        found[name] = position, covariance
        systems.add(stored["coordinate_system"])
    if len(systems) > 1 or not systems <= {WGS84, CARTESIAN, NOT_SAID}:
        raise malformed(path, "one coordinate system (-1, 0 or 1) of all priors", f"{sorted(map(repr, systems))}")
    positions = np.array([each[0] for each in found.values()]).reshape(-1, 3)
    covariances = np.array([each[1] for each in found.values()]).reshape(-1, 3, 3)
    return StoredPriors(tuple(found), positions, covariances, systems.pop() if systems else NOT_SAID)


def _tables_of(path: Path) -> Tables:
    """Return what can be read of the priors: the columns of this or an older schema."""
    problem: sqlite3.Error | None = None
    for tables in PRIOR_TABLES:
        try:
            open_database(path, tables).close()
        except sqlite3.Error as error:
            problem = problem or error
        else:
            return tables
    raise problem or sqlite3.DatabaseError("no such table: pose_priors")


def _numbers(path: Path, blob: object, num: int, what: str) -> FloatArray:
    """Return the float64 numbers of a blob; NaN where there is none."""
    if blob is None:
        return np.full(num, np.nan)
    if not isinstance(blob, bytes) or len(blob) != 8 * num:
        got = f"{len(blob)} bytes" if isinstance(blob, bytes) else type(blob).__name__
        raise malformed(path, f"{what} in {8 * num} bytes ({num} float64)", got)
    return np.frombuffer(blob, dtype="<f8").astype(np.float64)
