"""Files that are no files, files that end never, names in capitals: refused at once, in one line, without memory."""

import os
import socket
import struct
import threading
import time
import tracemalloc
from pathlib import Path

import pytest
from model_writer import noisy_model, rig_model, text_files, tiny_model, write_binary, write_text

from sfm_audit.loaders import LoadError, MalformedFileError, MissingFileError, UnreadableFileError, open_model
from sfm_audit.loaders.datasets.input_state import InputState, input_stamp, is_unchanged, read_input_state
from sfm_audit.loaders.paths import files
from sfm_audit.loaders.paths.files import open_regular, read_small

TERABYTES = 200 << 30


def refused(folder: Path, kind: type[LoadError] = LoadError) -> str:
    """The line that refuses a model, within two seconds and a few megabytes."""
    start = time.monotonic()
    tracemalloc.start()
    with pytest.raises(kind) as error:
        open_model(folder)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.monotonic() - start < 2.0
    assert peak < 100 << 20
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(("write", "suffix"), [(write_binary, ".bin"), (write_text, ".txt")])
@pytest.mark.parametrize("stem", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_pipe_a_device_and_a_socket_are_refused_without_waiting(tmp_path: Path, write, suffix: str, stem: str):
    path = write(tmp_path, rig_model()) / f"{stem}{suffix}"
    path.unlink()
    os.mkfifo(path)
    assert f"{path}: expected a file, found a named pipe" in refused(tmp_path, UnreadableFileError)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "found a device" in refused(tmp_path, UnreadableFileError)
    path.unlink()
    path.symlink_to("nowhere")
    assert "found a link to nothing (nowhere)" in refused(tmp_path, MissingFileError)
    path.unlink()
    path.mkdir()
    assert "found a folder" in refused(tmp_path, UnreadableFileError)


def test_a_socket_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        with pytest.raises(UnreadableFileError, match="found a socket"):
            open_regular(Path("socket"))


def test_a_file_that_becomes_a_pipe_between_asking_and_opening_is_refused(tmp_path: Path, monkeypatch):
    path = tmp_path / "f"
    path.write_bytes(b"x")
    real = files._open_without_waiting

    def exchange(opened: Path):
        opened.unlink()
        os.mkfifo(opened)
        return real(opened)

    monkeypatch.setattr(files, "_open_without_waiting", exchange)
    watchdog = threading.Timer(10.0, os._exit, [1])
    watchdog.start()
    with pytest.raises(UnreadableFileError, match="found a named pipe"):
        open_regular(path)
    watchdog.cancel()


def test_a_small_file_is_read_whole_or_refused(tmp_path: Path):
    path = tmp_path / "config.toml"
    path.write_bytes(b"alpha = 0.05\n")
    assert read_small(path, 100) == b"alpha = 0.05\n"
    with pytest.raises(MalformedFileError, match="expected at most 12 bytes, found more"):
        read_small(path, 12)
    with pytest.raises(UnreadableFileError, match="found a device"):
        read_small(Path("/dev/zero"), 100)
    with pytest.raises(UnreadableFileError, match="null"):
        read_small(Path("a\0b"), 100)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_file_grown_by_zeros_is_refused_at_once(tmp_path: Path, name: str):
    write_binary(tmp_path, rig_model())
    os.truncate(tmp_path / name, TERABYTES)
    assert str(tmp_path / name) in refused(tmp_path)
    start = time.monotonic()
    with pytest.raises(LoadError, match=name):  # what a run does first: it hashes the content
        read_input_state(str(tmp_path))
    assert time.monotonic() - start < 2.0


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"])
def test_a_text_file_grown_by_zeros_is_refused_at_its_first_nul(tmp_path: Path, name: str):
    write_text(tmp_path, rig_model())
    os.truncate(tmp_path / name, TERABYTES)
    assert "expected text, found a NUL byte" in refused(tmp_path, MalformedFileError)
    with pytest.raises(LoadError, match="NUL"):
        read_input_state(str(tmp_path))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_file_of_zeros_with_a_great_count_is_refused_at_its_second_record(tmp_path: Path, name: str):
    write_binary(tmp_path, rig_model())
    with (tmp_path / name).open("r+b") as file:
        file.truncate(8)
        file.write(struct.pack("<Q", 10**9))
        file.truncate(TERABYTES)
    assert str(tmp_path / name) in refused(tmp_path)


@pytest.mark.parametrize("piece_bytes", [1, 60, 100, 1000])
def test_points_are_the_same_in_pieces_of_any_size(tmp_path: Path, monkeypatch, piece_bytes: int):
    write_binary(tmp_path, noisy_model())
    whole = open_model(tmp_path)
    monkeypatch.setattr("sfm_audit.loaders.colmap.binary_points._PIECE_BYTES", piece_bytes)
    pieces = open_model(tmp_path)
    assert (whole.points.xyz_world == pieces.points.xyz_world).all()
    assert (whole.points.point3d_id == pieces.points.point3d_id).all()
    assert whole.findings == pieces.findings == ()


@pytest.mark.parametrize("piece_bytes", [1, 7, 64])
def test_lines_are_the_same_in_pieces_of_any_size(tmp_path: Path, monkeypatch, piece_bytes: int):
    for name, content in text_files(noisy_model()).items():
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + content)
    whole = open_model(tmp_path)
    monkeypatch.setattr("sfm_audit.loaders.paths.text_lines._PIECE_BYTES", piece_bytes)
    pieces = open_model(tmp_path)
    assert (whole.observations.xy_px == pieces.observations.xy_px).all()
    assert whole.findings == pieces.findings == ()


@pytest.mark.parametrize(("write", "suffix"), [(write_binary, ".bin"), (write_text, ".txt")])
def test_a_name_in_capitals_is_told_from_a_missing_file(tmp_path: Path, write, suffix: str):
    write(tmp_path, tiny_model())
    (tmp_path / f"images{suffix}").rename(tmp_path / f"IMAGES{suffix.upper()}")
    (tmp_path / f"points3D{suffix}").unlink()
    line = refused(tmp_path, MissingFileError)
    assert f"rename IMAGES{suffix.upper()} to images{suffix}; add points3D{suffix}" in line


def test_content_that_size_and_time_hide_is_found_when_asked(tmp_path: Path):
    path = write_binary(tmp_path, noisy_model()) / "points3D.bin"
    known = read_input_state(str(tmp_path))
    assert is_unchanged(str(tmp_path), known, verify=True)
    times, content = path.stat(), bytearray(path.read_bytes())
    content[20] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert input_stamp(str(tmp_path)) == known.stamp
    assert is_unchanged(str(tmp_path), known, verify=False)
    assert not is_unchanged(str(tmp_path), known, verify=True)
    os.utime(path)
    assert not is_unchanged(str(tmp_path), known, verify=False)
    content[20] ^= 1
    path.write_bytes(content)
    assert is_unchanged(str(tmp_path), known, verify=False), "touched, and the same content"
    assert is_unchanged(str(tmp_path), InputState(0, "", known.digest), verify=False)
