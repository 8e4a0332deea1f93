"""Databases and tables that are small on disk and not otherwise: refused in one line, nothing of them is run."""

import resource
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from model_writer import noisy_model, write_binary

from sfm_audit.loaders import LoadError, TruncatedFileError, open_model
from sfm_audit.loaders.colmap import sqlite_guard
from sfm_audit.loaders.colmap.database import read_keypoint_shapes
from sfm_audit.loaders.colmap.sqlite_guard import open_database
from sfm_audit.loaders.correspondences.scan_ptx import read_ptx
from sfm_audit.loaders.correspondences.table import read_correspondences

IMAGES = "CREATE TABLE images(image_id INTEGER PRIMARY KEY, name TEXT)"
KEYPOINTS = "CREATE TABLE keypoints(image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)"
ENDLESS = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT n, 'x' || n FROM r"
ZEROS = "CREATE VIEW keypoints(image_id, rows, cols, data) AS SELECT 1, 1, 4, zeroblob(500000000)"
GENERATED = KEYPOINTS.replace("data BLOB", "data BLOB GENERATED ALWAYS AS (zeroblob(500000000)) VIRTUAL")
VIRTUAL = "CREATE VIRTUAL TABLE images USING fts5(image_id, name)"
SCHEMAS = {
    "a view without end": ([KEYPOINTS, f"CREATE VIEW images(image_id, name) AS {ENDLESS}"], "images is no plain table"),
    "keypoints as a view": ([IMAGES, ZEROS], "keypoints is no plain table"),
    "a generated column": ([IMAGES, GENERATED], "column data of table keypoints is generated"),
    "a virtual table": ([KEYPOINTS, VIRTUAL], "images is no plain table"),
    "no table": ([IMAGES], "no such table: keypoints"),
    "no column": ([IMAGES, "CREATE TABLE keypoints(image_id INTEGER, rows INTEGER)"], "no column cols"),
}


@pytest.fixture
def model(tmp_path: Path):
    return open_model(write_binary(tmp_path / "model", noisy_model()))


def database(path: Path, statements: list[str], rows: list[tuple] = ()) -> Path:
    with closing(sqlite3.connect(path)) as db:
        for statement in statements:
            db.execute(statement)
        for table, *values in rows:
            db.execute(f"INSERT INTO {table} VALUES({', '.join('?' * len(values))})", values)
        db.commit()
    return path


@pytest.mark.parametrize("case", SCHEMAS)
def test_only_plain_tables_with_the_columns_are_read(tmp_path: Path, model, case: str):
    statements, why = SCHEMAS[case]
    path = database(tmp_path / "database.db", statements)
    start = time.monotonic()
    with pytest.raises(LoadError, match=why) as error:
        read_keypoint_shapes(path, model)
    assert time.monotonic() - start < 2.0
    assert "\n" not in str(error.value)


def rows_of(model, keypoint_rows: int = 1) -> list[tuple]:
    rows = []
    for image_id, name, num in zip(model.images.image_id, model.images.name, model.images.num_points2d, strict=True):
        blob = np.ones((num, 4), dtype="<f4").tobytes()
        rows.append(("images", int(image_id), name))
        rows += [("keypoints", int(image_id), int(num), 4, blob)] * keypoint_rows
    return rows


def test_two_rows_of_keypoints_and_two_images_of_a_name_are_named(tmp_path: Path, model):
    path = database(tmp_path / "good.db", [IMAGES, KEYPOINTS], rows_of(model))
    assert (read_keypoint_shapes(path, model).scale_px == 1.0).all()
    path = database(tmp_path / "twice.db", [IMAGES, KEYPOINTS], rows_of(model, keypoint_rows=2))
    with pytest.raises(LoadError, match=r"expected one row of keypoints for image 1 \('0.jpg'\), found two"):
        read_keypoint_shapes(path, model)
    path = database(tmp_path / "names.db", [IMAGES, KEYPOINTS], [*rows_of(model), ("images", 99, "0.jpg")])
    with pytest.raises(LoadError, match=r"expected one image called '0.jpg', found images 1 and 99"):
        read_keypoint_shapes(path, model)


def test_nothing_else_may_be_asked_and_nothing_written(tmp_path: Path, model):
    path = database(tmp_path / "database.db", [IMAGES, KEYPOINTS], rows_of(model))
    before = path.read_bytes()
    with closing(open_database(path)) as db:
        assert db.execute("SELECT name FROM images").fetchone() == ("0.jpg",)
        for statement in (
            "DELETE FROM images",
            "SELECT name FROM sqlite_master",
            "SELECT load_extension('x')",
            "SELECT upper(name) FROM images",
            "ATTACH ':memory:' AS other",
            "PRAGMA query_only = OFF",
            ENDLESS,
        ):
            with pytest.raises(sqlite3.DatabaseError, match=r"not authorized|prohibited|readonly"):
                db.execute(statement).fetchall()
    assert path.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["database.db", "model"]


def test_work_is_bounded(tmp_path: Path, model, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sqlite_guard, "_STEPS", (0, 0))
    path = database(tmp_path / "database.db", [IMAGES, KEYPOINTS], [("images", i, f"x{i}") for i in range(50_000)])
    with pytest.raises(LoadError, match="interrupted"):
        read_keypoint_shapes(path, model)


def peak_grown_by(path: Path, read) -> tuple[str, int]:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LoadError) as error:
        read(path)
    return str(error.value), (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) * 1024


def test_a_parquet_table_of_one_repeated_value_is_refused_by_its_footer(tmp_path: Path):
    one = pa.array(np.full(1_000_000, 1.5))
    table = pa.table(dict.fromkeys(("x", "y", "X", "Y", "Z"), one))
    table = table.replace_schema_metadata({"width": "1600", "height": "1200"})
    with pq.ParquetWriter(tmp_path / "bomb.parquet", table.schema, compression="zstd") as writer:
        for _ in range(20):
            writer.write_table(table)
    line, grown = peak_grown_by(tmp_path / "bomb.parquet", read_correspondences)
    assert "found 20000000 rows" in line
    assert grown < 64 << 20


def test_an_ignored_column_of_a_parquet_table_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    table = pa.table({**{name: pa.array([1.0, 2.0]) for name in "xyXYZ"}, "name": pa.array(["a", "b"])})
    pq.write_table(table.replace_schema_metadata({"width": "9", "height": "9"}), tmp_path / "t.parquet")
    read = []
    real = pq.ParquetFile.iter_batches

    def spy(self, batch_size, *, columns, **options):
        read.append(columns)
        return real(self, batch_size, columns=columns, **options)

    monkeypatch.setattr(pq.ParquetFile, "iter_batches", spy)
    assert read_correspondences(tmp_path / "t.parquet").num == 2
    assert read == [[name] for name in "xyXYZ"]


def test_a_scan_that_cannot_hold_its_points_is_refused_before_memory_is_taken(tmp_path: Path):
    header = "999999999\n999999999\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n"
    (tmp_path / "scan.ptx").write_text(header + "1 2 3 0.5\n" * 100)
    line, grown = peak_grown_by(tmp_path / "scan.ptx", read_ptx)
    assert "expected 999999998000000001 points" in line
    assert grown < 16 << 20
    with pytest.raises(TruncatedFileError):
        read_ptx(tmp_path / "scan.ptx")
