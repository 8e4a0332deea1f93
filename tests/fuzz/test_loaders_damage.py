"""Damaged files: a LoadError, or a model and its findings; no part of a model in silence, no other exception."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_promises import assert_is_a_model, damage
from model_writer import binary_files, rig_model, text_files, write_binary, write_text

from sfm_audit.loaders import FindingCode, LoadError, open_model

BINARY, TEXT = binary_files(rig_model()), text_files(rig_model())
HAND_WRITTEN = text_files(rig_model(), header=False)
DAMAGE = settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.mark.parametrize("name", BINARY)
def test_a_binary_file_cut_at_any_byte_is_refused(tmp_path: Path, name: str):
    write_binary(tmp_path, rig_model())
    for length in range(len(BINARY[name])):
        (tmp_path / name).write_bytes(BINARY[name][:length])
        with pytest.raises(LoadError) as error:
            open_model(tmp_path)
        assert error.value.path == str(tmp_path / name)


@pytest.mark.parametrize("name", sorted(set(TEXT) - {"cameras.txt"}))
def test_a_text_file_that_states_its_count_cut_at_any_byte_is_refused_or_whole(tmp_path: Path, name: str):
    """Only the line end may be missing, or 2D points that nothing links to: every link is in another file too."""
    write_text(tmp_path, rig_model())
    links = open_model(tmp_path).observations
    for length in range(len(TEXT[name])):
        (tmp_path / name).write_bytes(TEXT[name][:length])
        try:
            model = open_model(tmp_path)
        except LoadError:
            continue
        assert name in {"images.txt", "points3D.txt"}
        assert FindingCode.UNTERMINATED_TEXT in {finding.code for finding in model.findings}
        assert np.array_equal(model.observations.xy_px, links.xy_px)
        assert np.array_equal(model.observations.point_idx, links.point_idx)


def test_cameras_cut_in_the_last_number_are_a_finding_and_cut_before_it_refused(tmp_path: Path):
    """People edit cameras.txt and leave its last line unended; so a cut in its very last number can only be told."""
    write_text(tmp_path, rig_model())
    content = TEXT["cameras.txt"]
    last_number = content.rindex(b" ") + 1
    for length in range(len(content)):
        (tmp_path / "cameras.txt").write_bytes(content[:length])
        if length <= last_number:
            with pytest.raises(LoadError):
                open_model(tmp_path)
        else:
            assert FindingCode.UNTERMINATED_TEXT in {finding.code for finding in open_model(tmp_path).findings}


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_without_a_stated_count_a_cut_is_refused_or_told(tmp_path: Path, name: str):
    """Cut between two lines such a file is a valid file: what it lacks shows where the other files refer to it."""
    write_text(tmp_path, rig_model(), header=False)
    (tmp_path / name).write_bytes(HAND_WRITTEN[name])
    as_it_is = open_model(tmp_path).findings  # the rig's poses are not those of its images file
    assert {finding.code for finding in as_it_is} <= {FindingCode.RIG_POSE_DISAGREES}
    for length in range(len(HAND_WRITTEN[name])):
        (tmp_path / name).write_bytes(HAND_WRITTEN[name][:length])
        try:
            model = open_model(tmp_path)
        except LoadError:
            continue
        assert set(model.findings) - set(as_it_is), f"{name} cut at {length} is read without a word"


def assert_refused_or_a_model(folder: Path, changed: str) -> None:
    """A change may also make another file the odd one out: one that lacks what the changed one now refers to."""
    message = None
    try:
        model = open_model(folder)
    except LoadError as error:
        message = str(error)
    if message is None:
        assert_is_a_model(model)
    else:
        assert "\n" not in message
        assert changed in message or "as its own comment says" in message


@pytest.mark.parametrize(("write", "files"), [(write_binary, BINARY), (write_text, TEXT)])
@DAMAGE
@given(data=st.data())
def test_changed_bytes_give_an_error_or_a_model(tmp_path: Path, write, files, data: st.DataObject):
    write(tmp_path, rig_model())
    name = data.draw(st.sampled_from(sorted(files)))
    (tmp_path / name).write_bytes(damage(data, files[name]))
    assert_refused_or_a_model(tmp_path, name)


@pytest.mark.parametrize(("write", "files"), [(write_binary, BINARY), (write_text, TEXT)])
@DAMAGE
@given(data=st.data())
def test_any_bytes_give_an_error_or_a_model(tmp_path: Path, write, files, data: st.DataObject):
    write(tmp_path, rig_model())
    name = data.draw(st.sampled_from(sorted(files)))
    (tmp_path / name).write_bytes(data.draw(st.binary(max_size=200)))
    assert_refused_or_a_model(tmp_path, name)
