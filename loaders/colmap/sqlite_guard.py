"""A SQLite database that is read and not obeyed: plain tables only, bounded work, nothing of its schema is run.

A database may be hostile: views without end, virtual tables, generated columns, functions in its schema, or blobs of
gigabytes. Its schema is not trusted, an authorizer allows reading a few tables and nothing else, and the number of
steps of SQLite's machine is bounded by the size of the file.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Final, TypeAlias

Tables: TypeAlias = Mapping[str, tuple[str, ...]]
"""Columns by table."""
TABLES: Final[Tables] = {"images": ("image_id", "name"), "keypoints": ("image_id", "rows", "cols", "data")}
"""What is read of keypoints."""
PAIR_TABLES: Final[Tables] = {**TABLES, "two_view_geometries": ("pair_id", "rows", "cols", "data", "config")}
"""What is read of verified pairs."""
_PRIOR: Final = ("position", "position_covariance", "coordinate_system")
PRIOR_TABLES: Final[tuple[Tables, ...]] = (
    {"images": TABLES["images"], "pose_priors": ("corr_data_id", "corr_sensor_type", *_PRIOR)},
    {"images": TABLES["images"], "pose_priors": ("image_id", *_PRIOR)},
    {"images": TABLES["images"], "pose_priors": ("image_id", _PRIOR[0], _PRIOR[2])},
)
"""What is read of position priors: as they are stored since rigs, before, and before they had covariances."""

_STEPS: Final = (10_000_000, 16)  # of SQLite's machine: this many, and so many per byte of the file
_STEPS_PER_CALL: Final = 10_000
_SETTINGS: Final = ("trusted_schema = OFF", "query_only = ON", "cell_size_check = ON", "mmap_size = 0")
_MAX_COLUMNS: Final = 100


def open_database(path: Path, tables: Tables = TABLES) -> sqlite3.Connection:
    """Open a database for reading ``tables`` alone; nothing is written, not even a lock.

    Raises
    ------
    sqlite3.Error
        It is no database, or one of ``tables`` is no plain table with the columns needed.
    """
    size = path.stat().st_size
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(min(size, 1_000_000_000), 100_000))
        db.setlimit(sqlite3.SQLITE_LIMIT_COLUMN, _MAX_COLUMNS)
        db.setlimit(sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH, 0)
        for setting in _SETTINGS:
            db.execute(f"PRAGMA {setting}")
        budget = _Budget(_STEPS[0] + _STEPS[1] * size)
        db.set_progress_handler(budget.spend, _STEPS_PER_CALL)
        for table, columns in tables.items():
            _check_table(db, table, columns)
        db.set_authorizer(_Reading(tables))
    except BaseException:
        db.close()
        raise
    return db


class _Budget:
    """Stops SQLite after a number of steps."""

    def __init__(self, steps: int) -> None:
        self._left = steps

    def spend(self) -> int:
        """Return 1, which interrupts the statement, when nothing is left."""
        self._left -= _STEPS_PER_CALL
        return int(self._left < 0)


def _check_table(db: sqlite3.Connection, table: str, columns: tuple[str, ...]) -> None:
    """Raise unless ``table`` is a plain table (no view, nothing virtual) whose columns are stored (not generated)."""
    kinds = db.execute("SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    if not kinds:
        raise sqlite3.DatabaseError(f"no such table: {table}")
    if len(kinds) != 1 or kinds[0][0] != "table" or not kinds[0][1]:
        raise sqlite3.DatabaseError(f"{table} is no plain table")
    hidden = {row[1]: row[6] for row in db.execute(f"PRAGMA table_xinfo({table})")}
    for column in columns:
        if column not in hidden:
            raise sqlite3.DatabaseError(f"no column {column} in table {table}")
        if hidden[column]:
            raise sqlite3.DatabaseError(f"column {column} of table {table} is generated")


class _Reading:
    """The authorizer: SELECT from the columns of some tables, asked by this program, not by a view or trigger."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def __call__(self, *asked: object) -> int:
        """Say whether SQLite may do this: action, table, column, database, view or trigger that asks."""
        action, table, column, _, source = asked
        if source is not None:
            return sqlite3.SQLITE_DENY
        if action == sqlite3.SQLITE_SELECT:
            return sqlite3.SQLITE_OK
        columns = self._tables.get(table) if isinstance(table, str) else None
        if action == sqlite3.SQLITE_READ and columns is not None and column in {*columns, "ROWID", "rowid", ""}:
            return sqlite3.SQLITE_OK
        return sqlite3.SQLITE_DENY
