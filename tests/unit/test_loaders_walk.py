"""Walks end, stay inside the PATH unless asked, and say what they left out."""

import os
import time
from pathlib import Path

import pytest
from model_writer import tiny_model, write_binary

from sfm_audit.loaders import UnreadableFileError, discover
from sfm_audit.loaders.datasets import walk as walk_module
from sfm_audit.loaders.datasets.walk import WalkLimits, walk


def visited(root: Path, **options) -> list[str]:
    seen = []

    def visit(folder):
        seen.append("/".join(folder.parts))
        return folder.folders

    met = walk(root, visit, **options)
    return [
        *seen,
        *(f"error: {error.got}" for error in met.errors),
        *(f"out: {Path(link).name}" for link in met.links_out),
    ]


def test_every_folder_once_in_the_order_of_names(tmp_path: Path):
    for name in ("b/y", "b/x", "a", "c"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "file").touch()
    assert visited(tmp_path) == ["", "a", "b", "b/x", "b/y", "c"]


def test_links_inside_are_followed_once_and_loops_end(tmp_path: Path):
    (tmp_path / "z" / "deep").mkdir(parents=True)
    (tmp_path / "a").symlink_to(tmp_path / "z")
    (tmp_path / "z" / "up").symlink_to("..")
    (tmp_path / "z" / "deep" / "self").symlink_to(".")
    assert visited(tmp_path) == ["", "a", "a/deep"]


def test_links_to_the_outside_are_followed_only_when_asked(tmp_path: Path):
    (tmp_path / "outside" / "below").mkdir(parents=True)
    (tmp_path / "root-beside").mkdir()
    root = tmp_path / "root"
    root.mkdir()
    (root / "out").symlink_to(tmp_path / "outside")
    (root / "slash").symlink_to("/")
    (root / "beside").symlink_to(tmp_path / "root-beside")
    assert visited(root) == ["", "out: beside", "out: out", "out: slash"]
    (root / "slash").unlink()
    assert visited(root, follow_links=True) == ["", "beside", "out", "out/below"]


def test_the_root_may_be_a_link(tmp_path: Path):
    (tmp_path / "there" / "below").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "there")
    assert visited(tmp_path / "link") == ["", "below"]


@pytest.mark.parametrize(
    ("limits", "seen", "why"),
    [
        (WalkLimits(max_depth=1), 3, "2 folders and what is below them, more than 1 folders deep"),
        (WalkLimits(max_folders=2), 2, "2 folders and what is below them, after 2 folders"),
        (WalkLimits(max_seconds=-1.0), 0, "1 folders and what is below them, after -1 s"),
    ],
)
def test_each_limit_is_one_line(tmp_path: Path, limits: WalkLimits, seen: int, why: str):
    for name in ("a/x", "b/y"):
        (tmp_path / name).mkdir(parents=True)
    found = visited(tmp_path, limits=limits)
    assert len(found) == seen + 1
    assert why in found[-1]


def test_a_deep_tree_beside_a_sound_model(tmp_path: Path):
    write_binary(tmp_path / "scene", tiny_model())
    here, deep = os.open(tmp_path, os.O_RDONLY), tmp_path / "deep"
    deep.mkdir()
    try:
        os.chdir(deep)
        for _ in range(100):
            os.mkdir("d" * 60)  # noqa: PTH102 - the path is too long to name
            os.chdir("d" * 60)
    finally:
        os.chdir(here)
        os.close(here)
    found = discover([tmp_path])
    assert [ref.scene for ref in found.refs] == ["scene"]
    (error,) = found.errors
    assert "more than 64 folders deep" in error.got
    assert len(str(error)) < 600
    os.system(f"rm -rf {deep}")  # noqa: S605 - shutil does not reach that deep


def test_a_link_to_the_file_system_s_root_is_noted_at_once(tmp_path: Path):
    write_binary(tmp_path / "scene", tiny_model())
    (tmp_path / "root").symlink_to("/")
    start = time.monotonic()
    found = discover([tmp_path])
    assert time.monotonic() - start < 1.0
    assert [ref.scene for ref in found.refs] == ["scene"]
    assert found.errors == ()
    (note,) = found.notes
    assert f"not followed: {tmp_path / 'root'}; give --follow-links" in note


def test_a_model_whose_files_lie_outside_is_refused_by_name_unless_asked(tmp_path: Path):
    outside = write_binary(tmp_path / "outside", tiny_model())
    folder = write_binary(tmp_path / "data" / "scene", tiny_model())
    (folder / "points3D.bin").unlink()
    (folder / "points3D.bin").symlink_to(outside / "points3D.bin")
    found = discover([tmp_path / "data"])
    assert found.refs == ()
    (error,) = found.errors
    assert isinstance(error, UnreadableFileError)
    assert "links to the outside: points3D.bin; give --follow-links" in str(error)
    assert len(discover([tmp_path / "data"], follow_links=True).refs) == 1
    assert len(discover([tmp_path]).refs) == 2, "inside of a PATH further up"


def test_a_folder_that_vanishes_while_it_is_walked_is_told(tmp_path: Path, monkeypatch):
    (tmp_path / "gone").mkdir()
    real = walk_module._listed

    def vanish(parts, path):
        if path.name == "gone":
            path.rmdir()
        return real(parts, path)

    monkeypatch.setattr(walk_module, "_listed", vanish)
    assert visited(tmp_path) == ["", "error: No such file or directory"]
