"""PTX scans: what NumPy reads of the same text, the published example, and neighbours on a known grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from sfm_audit.loaders.correspondences import scan_ptx
from sfm_audit.loaders.correspondences.gridded_scan import GriddedScan, neighbours
from sfm_audit.loaders.correspondences.scan_ptx import read_ptx
from sfm_audit.loaders.errors import LfsPointerError, MalformedFileError, TruncatedFileError

IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
SCANNER = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"


def ptx(columns, rows, lines, transformation=IDENTITY):
    return f"{columns}\n{rows}\n{SCANNER}{transformation}" + "".join(f"{line}\n" for line in lines)


def written(folder, text):
    (folder / "scan.ptx").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "scan.ptx"


@pytest.mark.parametrize("batch", [4, 1 << 18])
@pytest.mark.parametrize("colour", ["", " 168 183 142"])
def test_points_are_where_numpy_reads_them(tmp_path, monkeypatch, batch, colour):
    monkeypatch.setattr(scan_ptx, "_BATCH", batch)
    rng = np.random.default_rng(0)
    columns, rows = 5, 3
    points = rng.normal(size=(columns * rows, 3))
    points[[0, 7]] = 0.0
    turn = Rotation.from_euler("zyx", [0.3, -0.2, 0.1]).as_matrix()
    shift = np.array([558312.218127, 5240857.469093, 76.298415])
    lines = [f"{x!r}  {y!r}\t{z!r} 0.5{colour}" for x, y, z in points.tolist()]
    matrix = "".join(" ".join(repr(v) for v in row) + " 0\n" for row in turn.T.tolist())
    matrix += " ".join(repr(v) for v in shift.tolist()) + " 1\n"
    path = written(tmp_path, ptx(columns, rows, lines, matrix))
    scan = read_ptx(path)
    raw = np.loadtxt(path, skiprows=10)[:, :3]
    expected = raw @ turn.T + shift  # world = R point + t
    expected[(raw == 0.0).all(axis=1)] = np.nan
    assert scan.xyz_world.shape == (rows, columns, 3)
    for column in range(columns):
        for row in range(rows):
            assert_allclose(scan.xyz_world[row, column], expected[column * rows + row], rtol=1e-15, atol=1e-9)
    assert scan.path == str(path)


def test_the_published_example(tmp_path):
    """The first lines of https://paulbourke.net/dataformats/ptx, cut to one column of three rows."""
    lines = ["0 0 0 0.500000 0 0 0", "12.032272 -2.613480 -2.036392 0.159304 168 183 142"]
    lines.append("12.860123 -2.793289 -2.162979 0.183719 118 121 94")
    matrix = "0.644200 -0.764857 0.000038 0\n0.764857 0.644200 -0.000027 0\n-0.000004 0.000047 1.000000 0\n"
    matrix += "558312.218127 5240857.469093 76.298415 1\n"
    scan = read_ptx(written(tmp_path, ptx(1, 3, lines, matrix)))
    assert np.isnan(scan.xyz_world[0, 0]).all()
    x = 12.032272 * 0.6442 - 2.613480 * 0.764857 + 2.036392 * 0.000004 + 558312.218127
    y = -12.032272 * 0.764857 - 2.613480 * 0.6442 - 2.036392 * 0.000047 + 5240857.469093
    z = 12.032272 * 0.000038 + 2.613480 * 0.000027 - 2.036392 + 76.298415
    assert_allclose(scan.xyz_world[1, 0], [x, y, z], atol=1e-8)


P = "1 2 3 0.5"
WRONG = {
    "no whole number": ("a\n3\n" + SCANNER + IDENTITY, 1, "number of columns", "'a'"),
    "no rows": ("3\n0\n" + SCANNER + IDENTITY, 2, "number of rows", "'0'"),
    "header line": ("3\n3\n0 0\n", 3, "position", "2 values"),
    "header letters": ("3\n3\n0 0 x\n", 3, "position", "'x'"),
    "transposed": (ptx(1, 1, [P], "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n"), 10, "last column is 0 0 0 1", "5 6 7 1"),
    "letters": (ptx(2, 2, [P, P, "1 2 b 0.5", P]), 13, "numbers", "'b'"),
    "nan": (ptx(2, 2, [P, "1 2 nan 0.5", P, P]), 12, "numbers", "'nan'"),
    "NA": (ptx(2, 2, [P, "1 2 NA 0.5", P, P]), 12, "numbers", "'NA'"),
    "True": (ptx(2, 2, [P, "True 2 3 0.5", P, P]), 12, "numbers", "'True'"),
    "overflow": (ptx(2, 2, [P, "1 2 1e999 0.5", P, P]), 12, "finite", "'1e999'"),
    "short line": (ptx(2, 2, [P, P, P, "1 2 3"]), 14, "x y z", "3 values"),
    "short first line": (ptx(2, 2, ["1 2 3"] * 4), 11, "x y z", "3 values"),
    "blank line": (ptx(2, 2, [P, "", P, P]), 12, "x y z", "0 values"),
    "mixed lengths": (ptx(2, 2, [P, P, P + " 1 2 3", P]), 13, "4 values", "7"),
    "quoted": (ptx(2, 2, [P, '"1" 2 3 0.5', P, P]), 12, "numbers", "'\"1\"'"),
    "NUL": (ptx(2, 2, [P, "1\0 2 3 0.5", P, P]), 12, "numbers", "1"),
    "not text": (ptx(2, 2, [P, P]).encode() + b"\xff\xfe 2 3 4\n" + P.encode(), 13, "numbers", "\\xff"),
    "a long line": (ptx(2, 2, [P, P, P + " " * 9000, P]), 13, "at most 4096 bytes", "longer"),
    "two scans": (ptx(1, 1, [P]) + ptx(1, 1, [P]), 12, "end of the file", "'1"),
    "no return": (ptx(1, 2, ["0 0 0 0.5"] * 2), None, "a point", "without any return"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_line_is_named(tmp_path, case):
    text, line, wanted, got = WRONG[case]
    with pytest.raises(MalformedFileError) as error:
        read_ptx(written(tmp_path, text))
    assert str(error.value.position) == (f"line {line}" if line else "None")
    assert wanted in error.value.wanted
    assert got in error.value.got


def test_a_carriage_return_is_white_space_and_the_last_line_may_be_unended(tmp_path):
    text = ptx(2, 2, [P, "1 2\r3 0.5", P, P]).replace("\n", "\r\n").rstrip()
    assert_array_equal(read_ptx(written(tmp_path, text)).xyz_world, np.tile([1.0, 2.0, 3.0], (2, 2, 1)))


def test_a_scan_with_fewer_points_than_stated_is_cut(tmp_path):
    with pytest.raises(TruncatedFileError, match="expected 999999999000 points, columns times rows, at least"):
        read_ptx(written(tmp_path, ptx(999_999_999, 1000, [P] * 3)))
    with pytest.raises(LfsPointerError):
        read_ptx(written(tmp_path, "version https://git-lfs.github.com/spec/v1\n"))


def wall(rows=5, columns=7, tilt_step=0.01, pan_step=0.02):
    tilt, pan = np.meshgrid(tilt_step * np.arange(rows), pan_step * np.arange(columns), indexing="ij")
    return 10.0 * np.stack([np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], axis=-1)


def test_the_next_column_and_row_or_else_the_previous():
    grid = wall()
    grid[2, 4] = np.nan
    found = neighbours(GriddedScan(grid), grid[[1, 4, 2, 1], [1, 6, 3, 4]])
    assert found.faults == {}
    assert_array_equal(found.pan_xyz_world, grid[[1, 4, 2, 1], [2, 5, 2, 5]])
    assert_array_equal(found.tilt_xyz_world, grid[[2, 3, 3, 0], [1, 6, 3, 4]])


def test_a_point_between_two_columns_of_returns_that_are_missing_cannot_be_used():
    grid = wall()
    grid[2, [2, 4]] = np.nan
    found = neighbours(GriddedScan(grid), grid[[2, 0], [3, 0]])
    assert list(found.faults) == [0]
    assert "row 2, column 3 (from 0), without a neighbour in pan on either side" in found.faults[0]
    assert "tilt" in neighbours(GriddedScan(grid[:1]), grid[0, :1]).faults[0]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 9999), share=st.floats(0.0, 1.5), gain=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_point_is_the_scan_s_up_to_half_a_step_in_any_unit(seed, share, gain):
    """Moved outwards, along the ray: then the nearest point of the scan stays the one that it was."""
    rng = np.random.default_rng(seed)
    grid = gain * wall()
    row, column = int(rng.integers(5)), int(rng.integers(7))
    point = grid[row, column]
    step = np.linalg.norm(grid[(row + 1) if row < 4 else 3, column] - point)
    moved = point + share * step * point / np.linalg.norm(point)
    fault = neighbours(GriddedScan(grid), moved[None]).faults.get(0)
    assert (fault is None) == (share < 0.5) or abs(share - 0.5) < 1e-6
    assert fault is None or f"row {row}, column {column}" in fault
