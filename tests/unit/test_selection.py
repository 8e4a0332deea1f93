"""Lists of kept images, tables of the others, and which images of a run belong to a model."""

import csv
import io
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_writer import tiny_model, write_binary
from run_samples import make_ref, sample_tables, settings

from sfm_audit.loaders import ModelRef
from sfm_audit.loaders.datasets.input_state import InputState, read_input_state
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.export.selection import (
    COLUMNS,
    Keep,
    csv_text,
    images_of_model,
    list_text,
    quoted,
    read_images,
    removed_text,
    unquoted,
)
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore

VERDICTS = ("accepted", "rejected", "undetermined")
NAMES = [
    "a.jpg",
    'with "quotes" and <script>alert(1)</script>.jpg',
    "line\nend\r\n.jpg",
    "tab\tbell\x07.jpg",
    "\u05d0\u05d1\u05d2 \u202eright to left\u202c.jpg",
    "line separator\u2028 and next line\x85.jpg",
    '"quoted".jpg',
    " blanks at both ends ",
    "back\\slash\\n.jpg",
    "x" * 300,
    "",
]


def write_run(folder, *models: Any, finished=True):
    """Write a run folder; models are (ref, names, verdicts, state)."""
    with RunStore(folder, settings()) as store:
        for ref, names, verdicts, state in models:
            n = len(names)
            reasons = [["ks_rejected: p = 0.01", "other: 1, 2"]] * n
            images = {"image_name": list(names), "image_id": list(range(3, 3 + n)), "reasons": reasons}
            store.write(ref, state, sample_tables(ref, tuple(verdicts), **images), 0.1)
        if finished:
            store.finish(None, [], 1.0)
    return RunReader.open(folder)


def model(scene="a", component="0", names=("x.jpg", "y.jpg", "z.jpg"), verdicts=VERDICTS, path=None):
    location = path or f"data/{scene}/sparse/{component}"
    return make_ref(location, scene=scene, component=component), names, verdicts, InputState(1, "s", location)


def lines(run, keep=Keep.NOT_REJECTED):
    return list_text(run, read_images(run), keep).split("\n")[:-1]


def test_a_list_of_one_model_holds_names_only(tmp_path):
    run = write_run(tmp_path / "RUN", model())
    assert lines(run) == ["x.jpg", "z.jpg"]
    assert lines(run, Keep.ACCEPTED) == ["x.jpg"]


def test_a_list_of_several_models_names_scene_and_component(tmp_path):
    run = write_run(tmp_path / "RUN", model("b", "1"), model("a", "0", verdicts=("rejected",) * 3))
    assert lines(run) == ["b/1\tx.jpg", "b/1\tz.jpg"]


def test_models_that_a_list_cannot_tell_apart_are_refused(tmp_path):
    run = write_run(tmp_path / "RUN", model(path="one/a/sparse/0"), model(path="two/a/sparse/0"))
    with pytest.raises(RunFolderError, match="two models called a/0: one/a/sparse/0 and two/a/sparse/0"):
        list_text(run, read_images(run), Keep.NOT_REJECTED)


def test_a_name_that_a_kept_and_a_removed_image_share_is_refused(tmp_path):
    names = ("same.jpg", "x.jpg", "same.jpg", "same.jpg")
    run = write_run(tmp_path / "RUN", model(names=names, verdicts=("accepted", "accepted", "rejected", "undetermined")))
    words = (
        r"3 images called same\.jpg in a/0, 2 of them kept and 1 not; a list of names cannot tell them apart; use --"
    )
    with pytest.raises(RunFolderError, match=words):
        lines(run)
    with pytest.raises(RunFolderError, match="1 of them kept and 2 not"):
        lines(run, Keep.ACCEPTED)


def test_a_name_that_only_kept_images_share_stands_there_once(tmp_path):
    names = ("same.jpg", "x.jpg", "same.jpg", "y.jpg")
    one = model(names=names, verdicts=("accepted", "rejected", "undetermined", "accepted"))
    run = write_run(tmp_path / "RUN", one, model("b", names=("same.jpg", "z.jpg"), verdicts=("rejected", "accepted")))
    assert sorted(lines(run)) == ["a/0\tsame.jpg", "a/0\ty.jpg", "b/0\tz.jpg"]


def test_every_name_is_one_line_and_comes_back(tmp_path):
    run = write_run(tmp_path / "RUN", model(scene="s\t1\n", names=NAMES, verdicts=["accepted"] * len(NAMES)), model())
    text = list_text(run, read_images(run), Keep.NOT_REJECTED)
    assert len(text.splitlines()) == len(NAMES) + 2, "also for readers that know Unicode's line ends"
    fields = [line.split("\t") for line in text.splitlines()]
    assert [len(field) for field in fields] == [2] * len(fields)
    named = [(unquoted(scene), unquoted(name)) for scene, name in fields]
    assert sorted(named) == sorted([*(("s\t1\n/0", name) for name in NAMES), ("a/0", "x.jpg"), ("a/0", "z.jpg")])


@given(st.text())
def test_quoting_is_undone_and_never_ambiguous(name):
    line = quoted(name)
    assert unquoted(line) == name
    assert len(f"{line}\n".splitlines()) == 1
    assert "\t" not in line
    assert line.encode() or not name
    assert line == line.strip()
    if line.startswith('"'):
        assert json.loads(line) == name
    else:
        assert line == name


def test_ordinary_names_are_written_as_they_are():
    for name in ("a.jpg", "dir/b c.jpg", "back\\slash.jpg", "Zürich 東.png", 'the "x".jpg', "#1.jpg", "\u05d0.jpg"):
        assert quoted(name) == name


def test_the_table_of_the_removed_holds_names_verdicts_and_reasons(tmp_path):
    run = write_run(tmp_path / "RUN", model(names=NAMES, verdicts=["rejected"] * len(NAMES)))
    rows = list(csv.DictReader(io.StringIO(removed_text(read_images(run)), newline="")))
    assert [unquoted(row["image_name"]) for row in rows] == NAMES
    assert {row["verdict"] for row in rows} == {"rejected"}
    assert rows[0]["reasons"] == "ks_rejected: p = 0.01; other: 1, 2"
    assert (rows[0]["scene"], rows[0]["component"], rows[0]["image_id"]) == ("a", "0", "3")


@pytest.mark.parametrize(
    "name", ["=cmd|'/c calc'!A1", "+1+1", "-1", "@SUM(1+1)", "\t=1", "\r=1", "\uff1d1", "\x1b[31mred"]
)
def test_a_table_holds_nothing_that_a_spreadsheet_or_a_terminal_obeys(name):
    text = csv_text([{"image_name": name, "index": -1}], ["image_name", "index"])
    (row,) = csv.DictReader(io.StringIO(text))
    assert row["image_name"].startswith('"')
    assert unquoted(row["image_name"]) == name
    assert row["index"] == "-1"
    assert text.replace("\n", "").isprintable()


def test_a_run_that_was_not_finished_is_refused(tmp_path):
    run = write_run(tmp_path / "RUN", model(), finished=False)
    with pytest.raises(RunFolderError, match="not finished"):
        read_images(run)


def test_a_run_without_images_is_refused(tmp_path):
    with pytest.raises(RunFolderError, match="no audited image"):
        read_images(write_run(tmp_path / "RUN"))


@pytest.fixture
def audited(tmp_path):
    """A run over the models a and b, and the folder of a."""
    entries = []
    for name, seen in (("a", tiny_model()), ("b", tiny_model().but(images=tiny_model().images[:2]))):
        folder = write_binary(tmp_path / name, seen)
        ref = ModelRef(name, name, "0", str(folder.resolve()), f"given/{name}")
        entries.append((ref, ["1.jpg", "2.jpg"], ("accepted", "rejected"), read_input_state(str(folder))))
    return write_run(tmp_path / "RUN", *entries), tmp_path


def test_the_images_of_a_model_are_found_by_its_location(audited):
    run, folder = audited
    images = images_of_model(run, read_images(run), folder / "." / "b")
    assert {image.model_path for image in images} == {"given/b"}
    assert [image.image_name for image in images] == ["1.jpg", "2.jpg"]
    (folder / "link").symlink_to(folder / "a")
    assert images_of_model(run, read_images(run), folder / "link")[0].model_path == "given/a"


def test_the_images_of_a_model_are_found_where_it_was_moved(audited):
    run, folder = audited
    shutil.move(folder / "a", folder / "elsewhere")
    assert images_of_model(run, read_images(run), folder / "elsewhere")[0].model_path == "given/a"


def test_a_model_that_changed_or_was_not_audited_is_refused(audited):
    run, folder = audited
    images = read_images(run)
    other = write_binary(folder / "c", tiny_model().but(images=(), points=()))
    with pytest.raises(RunFolderError, match=r"no audit of .*c; name one of its models"):
        images_of_model(run, images, other)
    write_binary(folder / "a", tiny_model().but(points=()))
    with pytest.raises(RunFolderError, match="before its files changed"):
        images_of_model(run, images, folder / "a")


def test_a_copy_of_two_audited_models_is_neither(tmp_path):
    folders = [write_binary(tmp_path / name, tiny_model()) for name in ("a", "b", "copy")]
    entries = [
        (ModelRef(folder.name, "s", "0", str(folder.resolve()), folder.name), ["1.jpg"], ("accepted",), state)
        for folder in folders[:2]
        for state in [read_input_state(str(folder))]
    ]
    run = write_run(tmp_path / "RUN", *entries)
    with pytest.raises(RunFolderError, match=r"holds 2 audits of copies of .*copy; name one of its models \("):
        images_of_model(run, read_images(run), folders[2])
    assert images_of_model(run, read_images(run), folders[1])[0].model_path == "b"


def test_a_table_without_a_column_is_named():
    run = SimpleNamespace(
        folder=Path("RUN"), info={"status": "complete"}, rows=lambda *_: iter([dict.fromkeys(COLUMNS[:-1])])
    )
    with pytest.raises(
        RunFolderError, match=f"RUN: has tables of images without {COLUMNS[-1]}; audit the models again"
    ):
        read_images(run)
