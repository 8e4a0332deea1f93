"""Which files make up a model, and what is said when one of them cannot be opened."""

import pickle
from pathlib import Path

import pytest
from model_writer import binary_files, rig_model, text_files, tiny_model, write_binary, write_text

from sfm_audit.loaders import (
    FindingCode,
    InputFile,
    LfsPointerError,
    LoadError,
    MissingFileError,
    TruncatedFileError,
    UnreadableFileError,
    input_files,
    open_model,
)
from sfm_audit.loaders.paths import files

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:89fc9e4e08ae\nsize 128\n"
BINARY, TEXT = tuple(binary_files(rig_model())), tuple(text_files(rig_model()))
WRITERS = [pytest.param(write_binary, BINARY, id="binary"), pytest.param(write_text, TEXT, id="text")]


@pytest.mark.parametrize(("write", "names"), WRITERS)
def test_what_is_no_readable_file_is_refused_by_name(tmp_path: Path, write, names):
    for number, name in enumerate(names):
        for kind, replace in (
            (LfsPointerError, lambda path: path.write_bytes(POINTER)),
            (TruncatedFileError, lambda path: path.write_bytes(b"")),
            (UnreadableFileError, Path.mkdir),
        ):
            folder = write(tmp_path / f"{number}-{kind.__name__}", rig_model())
            (folder / name).unlink()
            replace(folder / name)
            with pytest.raises(kind) as error:
                open_model(folder)
            assert error.value.path == str(folder / name)


@pytest.mark.parametrize(("write", "names"), WRITERS)
def test_a_missing_file_is_named(tmp_path: Path, write, names):
    for number, name in enumerate(names[:3]):
        folder = write(tmp_path / str(number), tiny_model())
        (folder / name).unlink()
        with pytest.raises(MissingFileError, match=rf"add {name}") as error:
            open_model(folder)
        assert error.value.path == str(folder)


def test_half_of_each_format_is_no_model(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    write_text(tmp_path, tiny_model())
    (tmp_path / "images.bin").unlink()
    (tmp_path / "cameras.txt").unlink()
    (tmp_path / "points3D.txt").unlink()
    with pytest.raises(MissingFileError, match=r"only cameras.bin, points3D.bin, images.txt; add images.bin"):
        open_model(tmp_path)


def test_a_folder_that_does_not_exist_and_a_file_in_its_place(tmp_path: Path):
    with pytest.raises(MissingFileError, match="expected a model folder, found nothing"):
        open_model(tmp_path / "nowhere")
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(UnreadableFileError, match="expected a model folder, found a file"):
        open_model(tmp_path / "file")
    with pytest.raises(MissingFileError, match="found none of them"):
        open_model(tmp_path)


def test_permission_and_disk_errors_are_load_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_binary(tmp_path, tiny_model())

    def refuse(*_args: object):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files, "_open_without_waiting", refuse)
    with pytest.raises(UnreadableFileError, match=r"cameras.bin: .* found Permission denied"):
        open_model(tmp_path)


def test_load_errors_survive_a_process_boundary(tmp_path: Path):
    with pytest.raises(LoadError) as error:
        open_model(tmp_path)
    copy = pickle.loads(pickle.dumps(error.value))  # noqa: S301 - our own bytes
    assert (type(copy), str(copy)) == (type(error.value), str(error.value))


def test_binary_is_taken_where_both_are_there(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    write_text(tmp_path, tiny_model())
    model = open_model(tmp_path)
    assert (model.file_format, model.findings) == ("binary", ())


def test_text_that_disagrees_in_counts_is_a_finding(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    write_text(tmp_path, tiny_model().but(images=tiny_model().images[:2], points=()))
    (finding,) = open_model(tmp_path).findings
    assert (finding.code, finding.count) == (FindingCode.BINARY_TEXT_DISAGREE, 2)
    assert "3 images in binary, 2 in text; 3 points3D in binary, 0 in text" in finding.text


def test_text_beside_binary_that_cannot_be_read_is_a_finding(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    (tmp_path / "images.txt").write_bytes(POINTER)
    (finding,) = open_model(tmp_path).findings
    assert finding.code == FindingCode.BINARY_TEXT_DISAGREE
    assert "images.txt cannot be read (a Git LFS pointer)" in finding.text


def test_text_is_taken_where_binary_is_incomplete_and_a_finding_says_so(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    write_text(tmp_path, tiny_model())
    (tmp_path / "points3D.bin").unlink()
    model = open_model(tmp_path)
    assert model.file_format == "text"
    assert [(f.code, f.count) for f in model.findings] == [(FindingCode.BINARY_TEXT_DISAGREE, 2)]


def test_input_files_are_those_that_were_read(tmp_path: Path):
    write_binary(tmp_path, rig_model())
    write_text(tmp_path, rig_model())
    assert [file.name for file in input_files(tmp_path)] == [*BINARY[:3], "rigs.bin", "frames.bin"]
    (tmp_path / "images.bin").unlink()
    assert [file.name for file in input_files(tmp_path)] == [*TEXT[:3], "rigs.txt", "frames.txt"]
    (tmp_path / "cameras.txt").write_bytes(b"abc")
    abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1
    assert input_files(tmp_path)[0] == InputFile("cameras.txt", 3, abc)
