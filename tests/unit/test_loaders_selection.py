"""Which models are asked for, and what is said of names that fit nothing."""

from dataclasses import replace
from pathlib import Path

import pytest

from sfm_audit.loaders import LoadError, ModelRef
from sfm_audit.loaders.datasets.discover import Discovery
from sfm_audit.loaders.datasets.selection import Selection, read_scene_list, select

NAMES = [("0001", "0"), ("0001", "1"), ("0022", "0"), ("001/234", "0"), ("001/235", "0")]
FOUND = Discovery(tuple(ModelRef("d", s, c, f"/{s}-{c}", f"{s}-{c}") for s, c in NAMES), ())


def chosen(**wanted) -> list[tuple[str, str]]:
    found = select(FOUND, Selection(**wanted))
    assert found.errors == ()
    assert sorted([*found.refs, *found.left_out], key=lambda ref: ref.location) == sorted(
        FOUND.refs, key=lambda ref: ref.location
    )
    return [(ref.scene, ref.component) for ref in found.refs]


@pytest.fixture
def listed(tmp_path: Path):
    def write(text: str, encoding: str = "utf-8"):
        (tmp_path / "scenes.txt").write_bytes(text.encode(encoding))
        return read_scene_list(tmp_path / "scenes.txt")

    return write


def test_nothing_asked_for_is_everything():
    assert chosen() == NAMES


def test_globs():
    assert chosen(scenes=("0001",)) == NAMES[:2]
    assert chosen(scenes=("00*",), components=("1",)) == NAMES[1:2]
    assert chosen(scenes=("001/*",)) == NAMES[3:]
    assert chosen(scenes=("001*",)) == NAMES[3:], "a star crosses a slash"
    assert chosen(scenes=("0001", "0022")) == NAMES[:3]
    assert chosen(components=("[1-9]",)) == NAMES[1:2]


def test_what_a_layout_left_out_stays_left_out():
    elsewhere = ModelRef("d", "x", "0", "/x-0", "x-0")
    found = select(replace(FOUND, left_out=(elsewhere,)), Selection(scenes=("0001", "0022")))
    assert [ref.location for ref in found.left_out] == ["/001/234-0", "/001/235-0", "/x-0"]


def test_lists(listed):
    assert chosen(lists=(listed("0022\n"),)) == NAMES[2:3]
    assert chosen(lists=(listed("# train\r\n\r\n 0001/1 \r\n001/234\r\n", "utf-8-sig"),)) == [NAMES[1], NAMES[3]]
    assert chosen(lists=(listed("0001"),), scenes=("001/235",), components=("0",)) == [NAMES[0], NAMES[4]]


def test_names_that_fit_nothing_are_told_and_cost_nothing_else(listed):
    found = select(FOUND, Selection(("0022", "9*"), (), (listed("0001\nx\ny\nz\n"),)))
    assert [(ref.scene, ref.component) for ref in found.refs] == NAMES[:3]
    scene, names = found.errors
    assert "--scene '9*'" in str(scene)
    assert "0001, 001/234, 001/235, ..." in str(scene)
    assert "scenes.txt: line 2: expected scenes of these PATHs, found 'x' and 2 more" in str(names)
    (error,) = select(FOUND, Selection(("0022",), ("1",))).errors
    assert "none of the 5 models fits all of them" in str(error)


def test_nothing_more_is_said_of_paths_without_models(listed):
    problem = LoadError("p", None, "a", "b", "c")
    assert select(Discovery((), (problem,)), Selection(("x",), ("y",), (listed("z"),))).errors == (problem,)


@pytest.mark.parametrize(("content", "text"), [(b"", "an empty file"), (b"# x\n", "none"), (b"a\n\xff\n", "byte 2")])
def test_a_list_that_is_none(tmp_path: Path, content, text):
    (tmp_path / "scenes.txt").write_bytes(content)
    with pytest.raises(LoadError, match=text):
        read_scene_list(tmp_path / "scenes.txt")
    with pytest.raises(LoadError, match="nothing"):
        read_scene_list(tmp_path / "gone.txt")
