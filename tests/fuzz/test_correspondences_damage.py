"""Damaged correspondences and scans: a LoadError of one line, or all that the file holds; no other exception."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfm_audit.loaders import LoadError
from sfm_audit.loaders.correspondences.scan_ptx import read_ptx
from sfm_audit.loaders.correspondences.table import read_correspondences

CSV = b"# width=1600 height=1200 rows=3\nx,y,X,Y,Z,name\n1.5,2,3,4e1,5,a\n1.25,2.5,-3,4,5,b\n7,8,9,10,11,\n"
PTX = b"2\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n" + b"1 2 3.25 0.5 1 2 3\n" * 4
DAMAGE = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def parquet() -> bytes:
    table = pa.table({name: np.arange(1.0, 6.0) for name in ("x", "y", "X", "Y", "Z")})
    sink = pa.BufferOutputStream()
    pq.write_table(table.replace_schema_metadata({"width": "1600", "height": "1200"}), sink)
    return sink.getvalue().to_pybytes()


PARQUET = parquet()


def read_any(path: Path, content: bytes, *, is_scan: bool) -> bool:
    """Whether the file is read; its promises are checked."""
    path.write_bytes(content)
    message = None
    try:
        values = read_ptx(path).xyz_world if is_scan else numbers(path)
    except LoadError as error:
        message = str(error)
    if message is not None:
        assert str(path) in message
        assert "\n" not in message
        return False
    assert values.size > 0
    assert not np.isinf(values).any()
    assert is_scan or not np.isnan(values).any()
    return True


def numbers(path: Path) -> np.ndarray:
    found = read_correspondences(path)
    assert len(found.xy_px) == len(found.xyz_world) == found.num
    return np.column_stack([found.xy_px, found.xyz_world])


@pytest.mark.parametrize(("content", "is_scan"), [(CSV, False), (PARQUET, False), (PTX, True)])
def test_whole_it_is_read_and_cut_at_any_byte_refused(tmp_path: Path, content: bytes, is_scan: bool):
    assert read_any(tmp_path / "f", content, is_scan=is_scan)
    end = content.rindex(b" ") + 1 if is_scan else len(content)  # a scan's last number is a colour
    step = 1 if end < 500 else 29
    for length in [*range(0, end - 20, step), *range(end - 20, end)]:
        assert not read_any(tmp_path / "f", content[:length], is_scan=is_scan), length


@pytest.mark.parametrize(("content", "is_scan"), [(CSV, False), (PARQUET, False), (PTX, True)])
@DAMAGE
@given(data=st.data())
def test_changed_bytes_give_an_error_or_numbers(tmp_path: Path, content: bytes, is_scan: bool, data: st.DataObject):
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed) - 1))
        changed[at] = data.draw(st.integers(0, 255) | st.sampled_from(b' \n\r\0\xff-.#,"e9'))
    read_any(tmp_path / "f", bytes(changed), is_scan=is_scan)


@pytest.mark.parametrize("is_scan", [False, True])
@DAMAGE
@given(content=st.binary(max_size=120), head=st.sampled_from([b"", CSV[:55], PTX[:80], PARQUET[:4]]))
def test_any_bytes_give_an_error_or_numbers(tmp_path: Path, is_scan: bool, content: bytes, head: bytes):
    read_any(tmp_path / "f", head + content, is_scan=is_scan)
