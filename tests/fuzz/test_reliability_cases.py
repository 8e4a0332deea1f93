"""The hostile and damaged models that lie beside the corpus: a model with a finding, or one line; never a warning.

Each went wrong once, in the readers or behind them. The folder is found as the corpus is, and may be absent.
"""

import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from corpus import CORPUS

from sfm_audit.audit.engine.model import audit_model
from sfm_audit.loaders import LoadError, discover, open_model
from sfm_audit.loaders.colmap.database import read_keypoint_scales

CASES = CORPUS.parent / "cases" / "reliability"
IS_THERE = CASES.is_dir()
pytestmark = pytest.mark.skipif(not IS_THERE, reason=f"no cases at {CASES} (set SFM_AUDIT_CORPUS)")

SOUND = frozenset({"zz_good", "txt-noisyrig-118-WARN"})  # the second: coordinates of 4e9, which a scene may have


def models(kind: str) -> list[Path]:
    return sorted(path for path in (CASES / kind).iterdir() if path.is_dir()) if IS_THERE else []


def said_of(folder: Path) -> str:
    """What is said of a model: the codes of its findings, or the line that refuses it."""
    try:
        return ", ".join(str(finding.code) for finding in open_model(folder).findings)
    except LoadError as error:
        line = str(error)
    assert "\n" not in line
    assert str(folder) in line
    return line


@pytest.mark.parametrize("folder", [*models("models"), *models("fuzz")], ids=lambda path: path.name)
def test_an_odd_model_is_not_read_without_a_word(folder: Path):
    assert bool(said_of(folder)) == (folder.name not in SOUND)


TEXT = {
    "line_10MB_comment": "",
    "line_10MB_name": "stated_count_differs",
    "line_10MB_track": "tracks_disagree",
    "line_10MB_token": "non_finite_points",
    "crlf": "",
    "bom": "",
    "nul": "points3D.txt: line 9: expected text, found a NUL byte",
    "tabs": "",
    "negative_id": "points3D.txt: line 4: expected a 3D point id",
    "id_as_float": "",
    "digits_of_other_script": "points3D.txt: line 4: expected POINT3D_ID",
}


@pytest.mark.parametrize("kind", TEXT)
def test_odd_text_is_read_as_colmap_reads_it_or_refused_by_line(tmp_path: Path, kind: str):
    subprocess.run([sys.executable, CASES / "big_text.py", kind, tmp_path / "m"], check=True)
    start = time.process_time()
    said = said_of(tmp_path / "m")
    assert time.process_time() - start < 10.0
    assert (TEXT[kind] in said) if TEXT[kind] else not said


@pytest.mark.parametrize("kind", ["wrong_sensor", "unknown_sensor"])
def test_frames_that_name_another_sensor_are_told(tmp_path: Path, kind: str):
    subprocess.run([sys.executable, CASES / "frame_sensor.py", kind, tmp_path / "m"], check=True)
    assert "sensors_disagree" in said_of(tmp_path / "m")


SHAPES = ("one_pixel", "one_xyz", "0_points", "1_point", "3_points", "same_names", "focal_1e-3", "focal_1e7")


@pytest.mark.parametrize("kind", SHAPES)
def test_odd_shapes_have_verdicts_and_finite_numbers(tmp_path: Path, kind: str):
    subprocess.run([sys.executable, CASES / "shapes.py", kind, tmp_path / "m"], check=True)
    tables = audit_model(open_model(tmp_path / "m"))
    assert len(tables.images) == 5
    rows = zip(tables.images["verdict"].to_pylist(), tables.images["reasons"].to_pylist(), strict=True)
    assert all(reasons for verdict, reasons in rows if verdict != "accepted")
    for table in (tables.images, tables.cameras, tables.models):
        for name, column in zip(table.column_names, table.columns, strict=True):
            if pa.types.is_floating(column.type):
                assert pc.all(pc.is_finite(column.drop_null())).as_py() is not False, name


@pytest.mark.parametrize("kind", ["recursive_view", "two_rows"])
def test_a_hostile_database_is_one_line(tmp_path: Path, kind: str):
    subprocess.run([sys.executable, CASES / "sqlite_bombs.py", kind, tmp_path / "m"], check=True)
    with pytest.raises(LoadError) as error:
        read_keypoint_scales(open_model(tmp_path / "m"), str(tmp_path / "m"))
    assert "\n" not in str(error.value)
    assert str(tmp_path / "m") in str(error.value)


def test_all_of_them_are_found_as_models():
    found = discover([CASES / "models", CASES / "fuzz"])
    assert len(found.refs) == len(models("models")) + len(models("fuzz"))
    assert found.errors == ()
