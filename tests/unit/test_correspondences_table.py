"""Correspondences from CSV and Parquet: what pandas and pyarrow write comes back, and every wrong row is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from sfm_audit.loaders.correspondences.gridded_scan import GriddedScan
from sfm_audit.loaders.correspondences.table import read_correspondences
from sfm_audit.loaders.errors import (
    LfsPointerError,
    LoadError,
    MalformedFileError,
    MissingFileError,
    TruncatedFileError,
)

HEAD = "# width=1600 height=1200\n"
PLAIN = ("x", "y", "X", "Y", "Z")
FULL = (*PLAIN, "Xp", "Yp", "Zp", "Xt", "Yt", "Zt")


def frame(num=24, columns=FULL, seed=0):
    rng = np.random.default_rng(seed)
    table = pd.DataFrame(rng.uniform(0.0, 1200.0, (num, len(columns))), columns=list(columns))
    return table * (1.0 + 1e-16)


def written(path, table, kind, **facts):
    if kind == "csv":
        head = "".join(f"# {key}={value}\n" for key, value in facts.items())
        path.write_text(head + table.to_csv(index=False, float_format="%.17g"))
    else:
        arrow = pa.Table.from_pandas(table, preserve_index=False)
        metadata = {key: str(value) for key, value in facts.items()}
        pq.write_table(arrow.replace_schema_metadata({**arrow.schema.metadata, **metadata}), path)
    return path


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("columns", [PLAIN, FULL, (*PLAIN[::-1], "name")])
def test_what_pandas_writes_comes_back(tmp_path, kind, columns):
    table = frame(columns=columns)
    if "name" in columns:
        table["name"] = 'a "corner", left'
    found = read_correspondences(written(tmp_path / "table.any", table, kind, width=1600, height=1200))
    assert (found.width, found.height, found.num) == (1600, 1200, 24)
    assert_array_equal(found.xy_px, table[["x", "y"]])
    assert_array_equal(found.xyz_world, table[["X", "Y", "Z"]])
    assert found.has_neighbours == ("Xp" in columns)
    if found.has_neighbours:
        assert_array_equal(found.pan_xyz_world, table[["Xp", "Yp", "Zp"]])
        assert_array_equal(found.tilt_xyz_world, table[["Xt", "Yt", "Zt"]])


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=st.lists(st.floats(0, 1200), min_size=5, max_size=5),
    layout=st.sampled_from(["{}", " {} ", "+{}"]),
    newline=st.sampled_from(["\n", "\r\n", "\n\n", "\n# a comment\n"]),
    mark=st.sampled_from(["", "\ufeff"]),
)
def test_numbers_are_read_exactly_whatever_the_layout(tmp_path, values, layout, newline, mark):
    cells = ",".join(layout.format(repr(value)) for value in values)
    (tmp_path / "c.csv").write_bytes(f"{mark}{HEAD}x,y,X,Y,Z{newline}{cells}{newline}".encode())
    found = read_correspondences(tmp_path / "c.csv")
    assert_array_equal([*found.xy_px[0], *found.xyz_world[0]], values)


def test_integers_and_float32_of_parquet_are_numbers(tmp_path):
    table = pd.DataFrame({name: np.arange(1, 4, dtype=kind) for name, kind in zip(PLAIN, "if" * 3, strict=False)})
    found = read_correspondences(written(tmp_path / "c", table, "parquet"), width=5, height=4)
    assert_array_equal(found.xyz_world[:, 2], [1.0, 2.0, 3.0])


def test_the_size_comes_from_the_file_or_the_option_and_never_from_two_that_differ(tmp_path):
    path = written(tmp_path / "c.csv", frame(), "csv", width=1600)
    assert read_correspondences(path, height=1300).height == 1300
    assert read_correspondences(path, width=1600, height=1200).width == 1600
    with pytest.raises(MalformedFileError, match=r"height, px, found nothing; add a first line such as"):
        read_correspondences(path)
    with pytest.raises(MalformedFileError, match=r"expected width=1500, as the option says, found width=1600"):
        read_correspondences(path, width=1500, height=1200)
    with pytest.raises(MalformedFileError, match=r"whole number of px, found 0"):
        read_correspondences(path, height=0)


ROW = "1,2,3,4,5\n"
WRONG = {
    "letters": ("x,y,X,Y,Z\n" + ROW + "1,2,a,4,5\n", 4, "column X", "'a'"),
    "empty cell": ("x,y,X,Y,Z\n" + ROW + "1,2,3,,5\n", 4, "column Y", "an empty cell"),
    "nan": ("x,y,X,Y,Z\n1,nan,3,4,5\n", 3, "column y", "'nan'"),
    "inf": ("x,y,X,Y,Z\n1,2,3,4,-inf\n", 3, "column Z", "'-inf'"),
    "overflow": ("x,y,X,Y,Z\n1,2,3,4,1e999\n", 3, "column Z", "inf"),
    "underscore": ("x,y,X,Y,Z\n1,2,3,4,1_0\n", 3, "column Z", "'1_0'"),
    "other digits": ("x,y,X,Y,Z\n1,2,3,4,\u0663\n", 3, "column Z", "'\u0663'"),
    "short row": ("x,y,X,Y,Z\n# note\n1,2,3,4\n", 4, "5 values", "4"),
    "long row": ("x,y,X,Y,Z\n1,2,3,4,5,\n", 3, "5 values", "6"),
    "semicolons": ("x;y;X;Y;Z\n1;2;3;4;5\n", 2, "columns among", "'x;y;X;Y;Z'"),
    "misspelt column": ("x,y,X,Y,Z,Xq\n1,2,3,4,5,6\n", 2, "columns among x, y", "'Xq'"),
    "column twice": ("x,y,X,Y,Z,x\n1,2,3,4,5,6\n", 2, "once", "column x twice"),
    "missing column": ("x,y,X,Z\n1,2,3,4\n", 2, "column Y", "only x, y, X, Z"),
    "half a neighbour": ("x,y,X,Y,Z,Xp,Yp,Zp\n1,2,3,4,5,6,7,8\n", 2, "columns Xt, Yt, Zt", "only"),
    "neighbour is the point": ("x,y,X,Y,Z,Xp,Yp,Zp,Xt,Yt,Zt\n1,2,3,4,5,3,4,6,3,4,5\n", 3, "tilt", "X = 3"),
    "outside": ("x,y,X,Y,Z\n" + ROW + "1,1201,3,4,5\n", 4, "1600 x 1200 px", "y = 1201"),
    "pixel centres at 0": ("x,y,X,Y,Z\n-0.2,2,3,4,5\n", 3, "inside the image", "x = -0.2"),
    "open quote": ('x,y,X,Y,Z,name\n1,2,3,4,5,"a\nb"\n', 3, "separated by commas", "unexpected end"),
    "not UTF-8": (b"x,y,X,Y,Z,name\n1,2,3,4,5,\xe9\n", 3, "UTF-8", "0xe9"),
    "a NUL": ("x,y,X,Y,Z\n1,2,3,4,5\0\n", 3, "text", "NUL"),
    "size twice": ("# width=1500\nx,y,X,Y,Z\n" + ROW, 2, "width=1600", "width=1500"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_row_is_named(tmp_path, case):
    text, line, wanted, got = WRONG[case]
    (tmp_path / "c.csv").write_bytes(HEAD.encode() + (text if isinstance(text, bytes) else text.encode()))
    with pytest.raises(MalformedFileError) as error:
        read_correspondences(tmp_path / "c.csv")
    assert str(error.value.position) == f"line {line}"
    assert wanted in error.value.wanted
    assert got in error.value.got
    assert str(error.value).startswith(f"{tmp_path}/c.csv: line {line}: expected ")


def test_all_rows_with_the_same_fault_are_named(tmp_path):
    rows = "1,2,3,4,5\n1700,2,3,4,5\n" * 12
    (tmp_path / "c.csv").write_text(HEAD + "x,y,X,Y,Z\n" + rows)
    with pytest.raises(MalformedFileError, match=r"line 4: .* \(likewise lines 6, 8, .*, 24 and 1 more\)"):
        read_correspondences(tmp_path / "c.csv")


@pytest.mark.parametrize(
    ("text", "kind", "got"),
    [
        ("", TruncatedFileError, "an empty file"),
        ("# nothing\n", TruncatedFileError, "none"),
        ("x,y,X,Y,Z\n", TruncatedFileError, "none"),
        ("x,y,X,Y,Z\n1,2,3,4,5", TruncatedFileError, "its last number may be cut"),
        ("# rows=3\nx,y,X,Y,Z\n" + ROW, MalformedFileError, "1"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", LfsPointerError, "a Git LFS pointer"),
    ],
)
def test_an_incomplete_file_is_refused(tmp_path, text, kind, got):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(kind) as error:
        read_correspondences(str(tmp_path / "c.csv"), width=9, height=9)
    assert got in error.value.got


def test_nothing_there_is_told(tmp_path):
    with pytest.raises(MissingFileError):
        read_correspondences(tmp_path / "none.csv", width=9, height=9)


@pytest.mark.parametrize(
    ("column", "position", "got"),
    [
        (pa.array([1.0, None, 2.0]), "row 2", "null"),
        (pa.array([1.0, 2.0, np.nan]), "row 3", "nan"),
        (pa.array(["1", "2", "3"]), "None", "string"),
        (pa.array([1, 2, 3000]), "row 3", "y = 3000"),
    ],
)
def test_a_wrong_row_of_parquet_is_named(tmp_path, column, position, got):
    table = pa.table({name: pa.array([1.0, 2.0, 3.0]) for name in PLAIN}).set_column(1, "y", column)
    pq.write_table(table, tmp_path / "c.parquet")
    with pytest.raises(MalformedFileError) as error:
        read_correspondences(tmp_path / "c.parquet", width=1600, height=1200)
    assert str(error.value.position) == position
    assert got in error.value.got


def test_parquet_without_rows_or_with_an_index_is_refused(tmp_path):
    written(tmp_path / "c", frame(0), "parquet")
    with pytest.raises(MalformedFileError, match="at least one row"):
        read_correspondences(tmp_path / "c", width=9, height=9)
    frame().iloc[[3, 1, 2]].to_parquet(tmp_path / "d")
    with pytest.raises(MalformedFileError, match="__index_level_0__"):
        read_correspondences(tmp_path / "d", width=9, height=9)


def grid_scan(rows=6, columns=8):
    tilt, pan = np.meshgrid(0.01 * np.arange(rows), 0.02 * np.arange(columns), indexing="ij")
    xyz = np.stack([np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], axis=-1)
    return GriddedScan(10.0 * xyz, "wall.ptx")


def test_neighbours_are_looked_up_in_a_scan(tmp_path):
    scan = grid_scan()
    table = pd.DataFrame(np.column_stack([[5.0, 6.0], [5.0, 7.0], scan.xyz_world[[1, 5], [2, 7]]]), columns=PLAIN)
    path = written(tmp_path / "c.csv", table, "csv", width=20, height=20)
    found = read_correspondences(path, scan=scan)
    assert_array_equal(found.pan_xyz_world, scan.xyz_world[[1, 5], [3, 6]])
    assert_array_equal(found.tilt_xyz_world, scan.xyz_world[[2, 4], [2, 7]])
    full = frame(2)
    with pytest.raises(MalformedFileError, match="neighbours from one source"):
        read_correspondences(written(tmp_path / "d.csv", full, "csv", width=1600, height=1200), scan=scan)


def test_points_that_are_not_of_the_scan_are_named(tmp_path):
    scan = grid_scan()
    table = pd.DataFrame(np.column_stack([[5.0] * 3, [5.0] * 3, scan.xyz_world[[1, 2, 3], [2, 2, 2]]]), columns=PLAIN)
    table.loc[1:, ["X", "Y", "Z"]] *= 1.01  # half a step is 0.05
    path = written(tmp_path / "c.csv", table, "csv", width=20, height=20)
    with pytest.raises(LoadError, match=r"line 5: expected a point of wall\.ptx .*\(likewise lines 6\)"):
        read_correspondences(path, scan=scan)


def test_the_documented_example_is_one(tmp_path):
    page = (Path(__file__).parents[2] / "docs/correspondences.md").read_text(encoding="utf-8")
    (tmp_path / "c.csv").write_text(page.split("```")[1].lstrip("\n"))
    found = read_correspondences(tmp_path / "c.csv")
    assert (found.num, found.has_neighbours) == (3, True)
    assert_array_equal(found.tilt_xyz_world[2], [-3.381, -2.747, 6.933])
