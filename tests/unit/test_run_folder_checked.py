"""What a run folder says is checked before it is believed; what it names is never opened because it stands there."""

import json
import os
import shutil
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from run_damage import forge_manifest
from run_samples import STATE, make_ref, sample_tables, settings

from sfm_audit.audit.cli.recompute import allowed_location
from sfm_audit.audit.cli.runs import open_run
from sfm_audit.loaders.datasets.input_state import InputState
from sfm_audit.reports.errors import DamagedRunError, OutputError, RunFolderError
from sfm_audit.reports.figures import ResidualError
from sfm_audit.reports.run_folder import store as store_module
from sfm_audit.reports.run_folder.parts import METADATA_KEY
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.record import read_run_json
from sfm_audit.reports.run_folder.store import RunFailure, RunStore

A = make_ref("data/a/sparse/0")
B = make_ref("data/b/sparse/0", scene="b")
REFS = (A, B)


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "RUN"
    with RunStore(folder, settings()) as store:
        for ref in REFS:
            store.write(ref, STATE, sample_tables(ref), 0.5)
        store.finish([ref.key for ref in REFS], [RunFailure("x", "x: cannot be read")], 1.0)
    return folder


def part(run: Path, table: str = "images", ref=A) -> Path:
    return run / table / f"part-{ref.key}.parquet"


def make_old(run: Path) -> None:
    """Make of a run folder one that was written before there was a manifest."""
    inputs = []
    for line in (run / "manifest.jsonl").read_text().splitlines():
        model = json.loads(line)
        del model["parts"]
        inputs.append({**model, "part": f"part-{model.pop('key')}.parquet"})
    info = json.loads((run / "run.json").read_text())
    del info["manifest"]
    for failure in info["failures"]:
        del failure["kind"], failure["report"]
    (run / "run.json").write_text(json.dumps({**info, "inputs": inputs}, indent=1))
    (run / "manifest.jsonl").unlink()


def after_another_input(path: Path) -> None:
    """Make of a part the one of the same model before its files changed."""
    table = pq.ParquetFile(path).read()
    said = json.loads(table.schema.metadata[METADATA_KEY])
    said["state"]["digest"] = "before"
    pq.write_table(table.replace_schema_metadata({METADATA_KEY: json.dumps(said)}), path)


def read_all(run: Path) -> list[dict]:
    reader = RunReader.open(run)
    for table in ("cameras", "models"):
        list(reader.rows(table, ["dataset"]))
    return list(reader.rows("images", ["scene", "image_name"]))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)


def link(path: Path) -> None:
    copy = path.parent.parent / "copy"
    shutil.copyfile(path, copy)
    path.unlink()
    path.symlink_to(copy)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


CHANGES = {
    "cut": (cut, "bytes, not"),
    "empty": (lambda path: path.write_bytes(b""), "0 bytes, not"),
    "flipped": (flip, "its bytes are not those that were written"),
    "gone": (Path.unlink, "is gone"),
    "link": (link, "a link"),
    "pipe": (pipe, "no plain file"),
    "other model": (lambda path: shutil.copyfile(path.with_name(part(Path(), ref=B).name), path), "is damaged"),
}


@pytest.mark.parametrize("table", ["images", "cameras", "models"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_part_that_does_not_fit_is_named_and_made_again(run, table, change):
    damage, words = CHANGES[change]
    before = read_all(run)
    damage(part(run, table))
    with pytest.raises(DamagedRunError) as caught:
        read_all(run)
    message = str(caught.value)
    assert f"{run}: its part {table}/{part(run).name} (data/a/sparse/0) is " in message
    assert words in message
    assert message.endswith("give its run command again, which audits what is damaged anew")
    assert "\n" not in message
    with RunStore(run, settings()) as store:
        assert store.finished(A) is None
        assert store.finished(B) == STATE
        store.write(A, STATE, sample_tables(A), 0.5)
        store.finish([ref.key for ref in REFS], [], 1.0)
    assert read_all(run) == before


@pytest.mark.parametrize("change", ["cut", "empty", "flipped", "gone", "link", "pipe"])
def test_a_manifest_that_does_not_fit_is_refused_and_the_intact_models_stay(run, change):
    damage, _ = CHANGES[change]
    damage(run / "manifest.jsonl")
    with pytest.raises(DamagedRunError, match=r"its manifest\.jsonl (is|cannot)"):
        RunReader.open(run)
    with RunStore(run, settings()) as store:
        known = [store.finished(ref) for ref in REFS]
    assert len([each for each in known if each]) == {"cut": 1, "flipped": 1}.get(change, 0)


def test_a_run_json_that_counts_other_models_than_its_manifest_has_is_refused(run):
    info = json.loads((run / "run.json").read_text())
    info["manifest"]["num_models"] += 1
    (run / "run.json").write_text(json.dumps(info))
    with pytest.raises(DamagedRunError, match=r"its manifest\.jsonl names 2 models, its run\.json 3"):
        RunReader.open(run)


def test_a_complete_run_that_does_not_say_which_models_it_holds_is_refused(run):
    info = json.loads((run / "run.json").read_text())
    del info["manifest"]
    (run / "run.json").write_text(json.dumps(info))
    with pytest.raises(DamagedRunError, match=r"its run\.json does not say which models it holds"):
        RunReader.open(run)


def test_a_model_that_the_manifest_does_not_name_is_not_there(run):
    stranger = make_ref("data/c/sparse/0", scene="c")
    with RunStore(run.parent / "OTHER", settings()) as store:
        store.write(stranger, STATE, sample_tables(stranger), 0.5)
        store.finish([stranger.key], [], 1.0)
    for table in ("images", "cameras", "models"):
        shutil.copyfile(part(run.parent / "OTHER", table, stranger), part(run, table, stranger))
    assert {row["scene"] for row in read_all(run)} == {"a", "b"}
    with RunStore(run, settings()) as store:
        assert store.finished(stranger) is None
        assert all(store.finished(ref) for ref in REFS)
        store.finish([ref.key for ref in REFS], [], 1.0)
    assert not part(run, "models", stranger).exists()


def test_a_line_is_on_the_disk_before_the_part_that_makes_its_model_whole(tmp_path, monkeypatch):
    """Killed in between, the model is not finished; killed after, it is."""
    write = store_module.write_whole

    def killed(path, content):
        if path.parent.name == "models":
            raise OutputError(path, "killed")
        write(path, content)

    monkeypatch.setattr(store_module, "write_whole", killed)
    with RunStore(tmp_path, settings()) as store, pytest.raises(OutputError):
        store.write(A, STATE, sample_tables(A), 0.5)
    monkeypatch.undo()
    assert A.key in (tmp_path / "manifest.jsonl").read_text()
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(A) is None
        store.write(A, STATE, sample_tables(A), 0.5)
    with RunStore(tmp_path, settings()) as store:  # killed before finish
        assert store.finished(A) == STATE


def test_a_line_that_was_being_written_is_passed_over(run):
    with RunStore(run, settings()) as store:
        store.write(A, InputState(1, "new", "new"), sample_tables(A), 0.5)
    with (run / "manifest.jsonl").open("ab") as file:
        file.write(b'{"key": "0123')
    assert len(read_all(run)) == 4  # a run that is under way
    with RunStore(run, settings()) as store:
        assert store.finished(A) == InputState(1, "new", "new")
        assert store.finished(B) == STATE
        store.finish([ref.key for ref in REFS], [], 1.0)
    assert len(read_all(run)) == 4


def test_a_model_that_failed_since_is_not_read_from_a_run_that_was_killed(run):
    with RunStore(run, settings()) as store:
        store.drop(A.key)
    assert {row["scene"] for row in read_all(run)} == {"b"}


def test_an_older_run_folder_is_read_with_a_note_and_audited_again(run, capsys):
    before = read_all(run)
    make_old(run)
    assert read_all(run) == before
    reader = open_run(run)
    assert capsys.readouterr().err == f"sfm-audit: {run} {reader.note}\n"
    assert "without hashes" in reader.note
    assert reader.info["failures"] == [
        {"location": "x", "message": "x: cannot be read", "kind": "unreadable", "report": None}
    ]
    assert [model.sha256 for model in reader.models()] == ["digest"] * 2
    with RunStore(run, settings()) as store:
        assert store.finished(A) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (Path.unlink, "is gone"),
        (cut, "is damaged"),
        (lambda path: shutil.copyfile(path.with_name(part(Path(), ref=B).name), path), "part of another model"),
        (lambda path: pq.write_table(pq.ParquetFile(path).read().slice(1), path), "1 rows, not 2"),
        (after_another_input, "of another state of it"),
    ],
)
def test_of_an_older_run_folder_labels_and_rows_are_checked(run, change, words):
    make_old(run)
    change(part(run))
    with pytest.raises(DamagedRunError, match=words):
        read_all(run)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"config": []}, "config: Input should be"),
        ({"config": {}}, "config.noise: Field required"),
        ({"failures": None}, "failures: Input should be a valid"),
        ({"failures": [1]}, "failures.0: "),
        ({"paths": "x"}, "paths: Input should be a valid"),
        ({"paths": [{"given": "x"}]}, "paths.0.real: Field required"),
        ({"counts": None}, "counts: Input should be"),
        ({"version": 1}, "version: Input should be a valid string"),
        ({"status": "done"}, "status: Input should be 'running' or 'complete'"),
        ({"tool": "other"}, "tool: Input should be 'sfm-audit'"),
        ({"seconds": float("nan")}, "seconds: "),
    ],
)
def test_run_json_is_checked_in_one_place(run, change, words):
    info = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**info, **change}))
    for opening in (lambda: RunReader.open(run), RunStore(run, settings()).__enter__):
        with pytest.raises(RunFolderError, match=r"its run\.json was not written by sfm-audit, or") as caught:
            opening()
        assert words in str(caught.value)
    (run / "run.json").unlink()  # the way out that the message names
    with RunStore(run, settings()) as store:
        assert all(store.finished(ref) for ref in REFS)


@pytest.mark.parametrize(
    "text", ["[" * 10**6, '{"a":' * 10**6, '{"tool": ' + "9" * 10**6 + "}", '{"failures": [' + "{}," * 10**5 + "{}]}"]
)
def test_a_run_json_that_is_a_bomb_costs_a_line_and_no_time(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    start = time.process_time()
    with pytest.raises(RunFolderError) as caught:
        read_run_json(tmp_path)
    assert time.process_time() - start < 1.0
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


def test_a_run_json_beyond_all_bounds_is_not_read(tmp_path):
    with (tmp_path / "run.json").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(RunFolderError, match=r"cannot be read \(larger than 32 MB\)"):
        RunReader.open(tmp_path)


def test_a_part_that_is_a_bomb_is_refused_by_its_footer(run):
    rows = pa.table({"image_id": pa.DictionaryArray.from_arrays(pa.array([0] * 3_000_000, pa.int8()), ["x"])})
    pq.write_table(rows, part(run))
    forge_manifest(run)
    with pytest.raises(DamagedRunError, match=r"3000000 rows in \d+ bytes"):
        read_all(run)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("scene", pa.array([1, 2]), "its column scene is of type int64, not string"),
        ("scene", pa.array(["a", None]), "its column scene has a null where there never is one"),
        ("reasons", pa.array([["x", None], []]), "its column reasons has a null"),
    ],
)
def test_columns_of_another_kind_are_refused(run, name, values, words):
    table = pq.ParquetFile(part(run)).read()
    i = table.column_names.index(name)
    field = pa.field(name, pa.list_(pa.field("element", pa.string()))) if name == "reasons" else name
    pq.write_table(table.set_column(i, field, values.cast(field.type) if name == "reasons" else values), part(run))
    forge_manifest(run)
    with pytest.raises(DamagedRunError, match=words):
        list(RunReader.open(run).rows("images", [name]))


def test_a_folder_of_parts_that_is_a_link_is_neither_read_nor_written(run):
    (run / "images").rename(run.parent / "elsewhere")
    (run / "images").symlink_to(run.parent / "elsewhere")
    with pytest.raises(DamagedRunError, match="images is a link"):
        read_all(run)
    with pytest.raises(RunFolderError, match="its images is a link"):
        RunStore(run, settings()).__enter__()
    assert len(list((run.parent / "elsewhere").iterdir())) == 2


def test_reports_of_failures_come_and_go(run):
    with RunStore(run, settings()) as store:
        store.drop(A.key)
        store.keep_report(A, "Traceback")
        failure = RunFailure(A.model_path, "a bug", "error", store.reports[A.model_path])
        store.finish([B.key], [failure], 1.0)
    assert failure.report == f"errors/{A.key}.txt"
    assert (run / failure.report).read_text() == "Traceback"
    assert json.loads((run / "run.json").read_text())["failures"][0]["kind"] == "error"
    with RunStore(run, settings()) as store:
        store.write(A, STATE, sample_tables(A), 0.5)
        store.finish([ref.key for ref in REFS], [], 1.0)
    assert list((run / "errors").iterdir()) == []


def test_models_of_a_path_that_is_away_stay_in_the_manifest_if_they_are_intact(run):
    with RunStore(run, settings()) as store:
        assert store.finished(B)
        store.finish(None, [], 1.0)
    assert len(read_all(run)) == 4
    cut(part(run))
    with RunStore(run, settings()) as store:
        assert store.finished(B)
        store.finish(None, [], 1.0)
    assert {row["scene"] for row in read_all(run)} == {"b"}


STORE = "s3://bucket/data/a?endpoint_override=127.0.0.1:1&scheme=http"


@pytest.mark.parametrize(
    ("paths", "model_path", "named", "expected"),
    [
        ([], "/data/a", (), "/data/a"),
        ([("data", "/real/data")], "data/a/sparse/0", (), "/real/data/a/sparse/0"),
        ([("data", "/real/data")], "database/a", (), "database/a"),
        ([], STORE, (), None),
        ([("data", STORE)], "data", (), None),
        ([("data", "gs://bucket")], "data/a", (), None),
        ([], "gs://bucket/data/a", ("s3://bucket/data",), None),
        ([], STORE, ("s3://bucket/dat",), None),
        ([], STORE, ("s3://bucket/data/b",), None),
        ([], STORE, ("s3://bucket/data",), "s3://bucket/data/a"),
        ([], STORE, ("s3://bucket/data?region=eu",), "s3://bucket/data/a?region=eu"),
        ([], "//host/share/a", (), None),
        ([], "\\\\host\\share\\a", (), None),
        ([("data", "//host/share")], "data/a", (), None),
        ([], "a\0b", (), None),
    ],
)
def test_a_run_folder_opens_nothing_in_an_object_store(paths, model_path, named, expected):
    recorded = [{"given": given, "real": real} for given, real in paths]
    if expected is None:
        with pytest.raises(ResidualError, match=r"not opened because a run folder says so|no path of this machine"):
            allowed_location(recorded, model_path, named)
    else:
        assert allowed_location(recorded, model_path, named) == expected
