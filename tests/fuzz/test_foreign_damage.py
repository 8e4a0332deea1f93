"""Damaged files of other programs: a LoadError, a finding, or the whole model; never part of one."""

import os
from pathlib import Path

import foreign_openmvg_binary as mvg
import foreign_scene as fs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_promises import assert_is_a_model, damage

from sfm_audit.loaders import LoadError, SparseModel, open_model
from sfm_audit.loaders.datasets.image_counts import count_images

LONG = fs.scene({"k1": -0.08, "k2": 0.0}, num_images=2, num_points=3)
TINY = LONG.but(
    rotations=np.array([np.eye(3)] * 2), translations=np.round(LONG.translations, 1), points=np.round(LONG.points, 1)
).but(xy=np.round(LONG.xy))
"""Short numbers: what is cut is every byte."""
FILES = {
    "bundler": fs.bundler_files(TINY),
    "bal": fs.bal_files(TINY),
    "nvm": fs.nvm_files(TINY, 0.05),
    "opensfm": fs.opensfm_files(TINY),
    "blocks_exchange": fs.blocks_exchange_files(TINY),
    "kapture": fs.kapture_files(TINY, with_rig=True),
    "openmvg": fs.openmvg_files(TINY, "pinhole_radial_k1"),
    "openmvg_binary": mvg.openmvg_binary_files(TINY, "pinhole_radial_k1"),
}
MODEL = {"kapture": "reconstruction"}
"""Where the model lies below the folder that was written."""
CASES = [(name, file) for name, files in FILES.items() for file in files if not file.endswith("1.jpg.kpt")]
"""All files; of kapture's keypoints the first, which is written as the second is."""
DAMAGE = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def same(one: SparseModel, other: SparseModel) -> bool:
    tables = [(one.images, other.images), (one.points, other.points), (one.observations, other.observations)]
    tables.append((one.cameras, other.cameras))
    return all(
        np.array_equal(np.asarray(getattr(x, field)), np.asarray(getattr(y, field)))
        for x, y in tables
        for field in type(x).__slots__
    )


def answer_of(ask, folder: Path):
    """What a question to a damaged model gives: an answer, or the error, which is one line that names the place."""
    try:
        answer = ask(folder)
    except LoadError as error:
        answer = error
    if isinstance(answer, LoadError):
        assert "\n" not in str(answer)
        assert str(folder) in str(answer)
    elif isinstance(answer, SparseModel):
        assert_is_a_model(answer)
    return answer


@pytest.mark.parametrize(("name", "file"), CASES)
def test_a_file_cut_at_any_byte_is_refused_told_or_whole(tmp_path: Path, name: str, file: str):
    files = FILES[name]
    folder = fs.write(tmp_path, files) / MODEL.get(name, "")
    whole = open_model(folder)
    known = {finding.code for finding in whole.findings}
    content = files[file]
    num_noticed = 0
    for length in range(len(content)):
        (tmp_path / file).write_bytes(content[:length])
        answer = answer_of(open_model, folder)
        if isinstance(answer, LoadError):
            num_noticed += 1
            continue
        told = {finding.code for finding in answer.findings} - known
        num_noticed += bool(told)
        assert told or same(answer, whole), f"{file} cut at {length} of {len(content)} is read without a word"
    assert num_noticed > 0.5 * len(content)


@pytest.mark.parametrize(("name", "file"), CASES)
@DAMAGE
@given(data=st.data())
def test_changed_bytes_give_an_error_or_a_model(tmp_path: Path, name: str, file: str, data: st.DataObject):
    fs.write(tmp_path, FILES[name])
    (tmp_path / file).write_bytes(damage(data, FILES[name][file]))
    answer_of(open_model, tmp_path / MODEL.get(name, ""))
    answer_of(lambda folder: count_images(str(folder)), tmp_path / MODEL.get(name, ""))


@pytest.mark.parametrize(("name", "file"), CASES)
@DAMAGE
@given(content=st.binary(max_size=200))
def test_any_bytes_give_an_error_or_a_model(tmp_path: Path, name: str, file: str, content: bytes):
    fs.write(tmp_path, FILES[name])
    (tmp_path / file).write_bytes(content)
    answer_of(open_model, tmp_path / MODEL.get(name, ""))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize(("name", "file"), CASES)
def test_a_pipe_is_refused_without_waiting(tmp_path: Path, name: str, file: str):
    fs.write(tmp_path, FILES[name])
    (tmp_path / file).unlink()
    os.mkfifo(tmp_path / file)
    with pytest.raises(LoadError, match="a named pipe"):
        open_model(tmp_path / MODEL.get(name, ""))
