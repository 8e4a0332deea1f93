import errno
import hashlib
import json
import os
import subprocess
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from run_damage import forge_manifest
from run_samples import STATE, make_ref, part_times, sample_tables, settings

from sfm_audit.audit.config import AuditConfig
from sfm_audit.loaders.datasets.input_state import InputState
from sfm_audit.reports.errors import DamagedRunError, OutputError, RunFolderError
from sfm_audit.reports.run_folder import disk
from sfm_audit.reports.run_folder import store as store_module
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore

A = make_ref("data/a/sparse/0")
B = make_ref("data/b/sparse/0", scene="b")


def write_run(folder: Path, refs=(A, B), run_settings=None) -> None:
    with RunStore(folder, run_settings or settings()) as store:
        for ref in refs:
            store.write(ref, STATE, sample_tables(ref), 0.5)
        store.finish([ref.key for ref in refs], [], 1.0)


def run_json(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def manifest(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]


def test_a_run_folder_holds_what_design_says(tmp_path):
    run = tmp_path / "new" / "RUN"
    write_run(run)
    for table in ("images", "cameras", "models"):
        assert sorted(path.name for path in (run / table).iterdir()) == sorted(f"part-{r.key}.parquet" for r in (A, B))
    info = run_json(run)
    assert (info["tool"], info["version"], info["status"]) == ("sfm-audit", "0.1.0", "complete")
    assert info["config"]["noise"] == "track"
    assert info["counts"] == {
        "num_models": 2,
        "num_images": 4,
        "num_accepted": 2,
        "num_rejected": 2,
        "num_undetermined": 0,
        "num_failures": 0,
    }
    inputs = {item["key"]: (item["model_path"], item["num_bytes"], item["sha256"]) for item in manifest(run)}
    assert inputs == {A.key: (A.model_path, 1000, "digest"), B.key: (B.model_path, 1000, "digest")}


def test_rows_and_hash_of_every_part_stand_in_the_manifest_and_its_hash_in_run_json(tmp_path):
    write_run(tmp_path)
    content = (tmp_path / "manifest.jsonl").read_bytes()
    assert run_json(tmp_path)["manifest"] == {"num_models": 2, "sha256": hashlib.sha256(content).hexdigest()}
    assert [item["key"] for item in manifest(tmp_path)] == sorted([A.key, B.key])
    for item in manifest(tmp_path):
        assert item["parts"].keys() == {"images", "cameras", "models"}
        for table, part in item["parts"].items():
            file = tmp_path / table / f"part-{item['key']}.parquet"
            known = subprocess.run(["sha256sum", file], capture_output=True, text=True, check=True).stdout[:64]
            rows = pa.parquet.ParquetFile(file).metadata.num_rows
            assert part == {"rows": rows, "num_bytes": file.stat().st_size, "sha256": known}


def test_pandas_reads_all_parts_of_a_table_at_once(tmp_path):
    write_run(tmp_path)
    (tmp_path / "images" / ".tmp-part-1.parquet").write_bytes(b"cut short")
    frame = pd.read_parquet(tmp_path / "images")
    assert len(frame) == 4
    assert set(frame["scene"]) == {"a", "b"}
    assert frame["image_id"].dtype == "uint32"
    assert list(pd.read_parquet(f"{tmp_path}/models")["num_images"]) == [2, 2]
    assert list(pd.read_parquet(f"{tmp_path}/cameras")["num_images"]) == [2, 2]


def test_the_reader_streams_the_rows_of_all_parts(tmp_path):
    write_run(tmp_path)
    rows = list(RunReader.open(tmp_path).rows("images", ("scene", "image_name")))
    assert sorted((row["scene"], row["image_name"]) for row in rows) == [
        *(("a", "IMG_0000.jpg"), ("a", "IMG_0001.jpg")),
        *(("b", "IMG_0000.jpg"), ("b", "IMG_0001.jpg")),
    ]
    with pytest.raises(RunFolderError, match="holds no run"):
        RunReader.open(tmp_path / "images")


def test_finished_models_are_known_with_their_input(tmp_path):
    write_run(tmp_path, [A])
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(A) == STATE
        assert store.finished(B) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda run: (run / "images" / f"part-{A.key}.parquet").unlink(),
        lambda run: (run / "cameras" / f"part-{A.key}.parquet").unlink(),
        lambda run: (run / "models" / f"part-{A.key}.parquet").unlink(),
        lambda run: (run / "models" / f"part-{A.key}.parquet").write_bytes(b"PAR1 cut"),
    ],
    ids=["no images", "no cameras", "no models", "broken"],
)
def test_a_model_with_parts_missing_or_broken_is_not_finished(tmp_path, change):
    write_run(tmp_path, [A])
    change(tmp_path)
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(A) is None


def test_another_version_or_other_labels_make_a_model_unfinished(tmp_path):
    write_run(tmp_path, [A])
    with RunStore(tmp_path, replace(settings(), version="0.2.0")) as store:
        assert store.finished(A) is None
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(replace(A, dataset="other")) is None
        assert store.finished(A) == STATE


def test_a_model_of_other_settings_is_unfinished_where_nothing_else_says_which_they_were(tmp_path):
    write_run(tmp_path, [A])
    (tmp_path / "run.json").unlink()  # as its message advises where it is damaged
    with RunStore(tmp_path, settings(alpha=0.1)) as store:
        assert store.finished(A) is None


def test_a_model_is_finished_with_observations_only_where_they_are_there(tmp_path):
    write_run(tmp_path, [A])
    with RunStore(tmp_path, replace(settings(), observations=True)) as store:
        assert store.finished(A) is None
        assert store.finished(B) is None


def test_a_line_that_names_two_models_finishes_neither(tmp_path):
    write_run(tmp_path, [A])
    path = tmp_path / "manifest.jsonl"
    path.write_text(path.read_text(encoding="utf-8").replace("}\n", f', "key": "{B.key}"}}\n'), encoding="utf-8")
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(A) is None
        assert store.finished(B) is None


def test_a_rewritten_model_is_unfinished_until_its_last_part(tmp_path, monkeypatch):
    write_run(tmp_path, [A])
    write = store_module.write_whole

    def fail_on_models(path: Path, content: bytes) -> None:
        if path.parent.name == "models":
            raise OutputError(path, "disk full")
        write(path, content)

    with RunStore(tmp_path, settings()) as store:
        monkeypatch.setattr(store_module, "write_whole", fail_on_models)
        with pytest.raises(OutputError):
            store.write(A, InputState(1, "new", "new"), sample_tables(A, ("rejected",)), 0.1)
        assert store.finished(A) is None


def test_the_models_part_which_says_finished_is_written_last(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(store_module, "write_whole", lambda path, _: written.append(path.parent.name))
    with RunStore(tmp_path, settings()) as store:
        written.clear()
        store.write(A, STATE, sample_tables(A), 0.1)
    assert written == ["images", "cameras", "models"]


def test_a_full_disk_is_one_line_and_leaves_finished_parts_and_no_other_files(tmp_path, monkeypatch):
    write_run(tmp_path, [A])
    before = part_times(tmp_path)

    def no_space(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunStore(tmp_path, settings()) as store:
        monkeypatch.setattr(os, "fsync", no_space)
        with pytest.raises(OutputError, match="No space left on device") as caught:
            store.write(B, STATE, sample_tables(B), 0.1)
    assert "\n" not in str(caught.value)
    assert part_times(tmp_path) == before
    assert not list(tmp_path.rglob(".tmp-*"))


def test_another_config_is_refused_and_named(tmp_path):
    write_run(tmp_path)
    with pytest.raises(RunFolderError, match=r"holds a run with alpha = 0\.05, not 0\.1; choose another -o"):
        RunStore(tmp_path, settings(alpha=0.1)).__enter__()
    assert run_json(tmp_path)["status"] == "complete"


def test_a_run_may_be_widened_but_never_narrowed(tmp_path):
    run = tmp_path / "RUN"
    write_run(run, [A], settings(["a"]))
    write_run(run, [A, B], settings(["a", "b"]))
    with pytest.raises(RunFolderError, match="holds a run over a, which this command leaves out"):
        RunStore(run, settings(["b"])).__enter__()
    with RunStore(run, settings([f"{Path.cwd()}/a", "./b"])) as store:
        assert store.finished(A) == STATE


def test_a_path_without_models_binds_nobody(tmp_path):
    typo = replace(settings(["a", "typo"]), empty_paths=frozenset({"typo"}))
    write_run(tmp_path, [A], typo)
    write_run(tmp_path, [A], settings(["a"]))
    assert [path["given"] for path in run_json(tmp_path)["paths"]] == ["a"]


def test_a_path_whose_models_are_gone_today_stays_bound(tmp_path):
    write_run(tmp_path, [A, B], settings(["a", "b"]))
    unmounted = replace(settings(["a", "b"]), empty_paths=frozenset({"b"}))
    with RunStore(tmp_path, unmounted) as store:
        store.finish(None, [("b", "b: nothing there")], 1.0)
    assert [path["given"] for path in run_json(tmp_path)["paths"]] == ["a", "b"]
    assert len(part_times(tmp_path)) == 6


def test_models_that_are_no_longer_there_are_removed_at_the_end(tmp_path):
    write_run(tmp_path, [A, B])
    with RunStore(tmp_path, settings()) as store:
        assert store.finished(A)
        store.finish([A.key], [], 1.0)
    assert set(part_times(tmp_path)) == {f"{name}/part-{A.key}.parquet" for name in ("images", "cameras", "models")}
    assert run_json(tmp_path)["counts"]["num_models"] == 1


def test_a_model_that_is_not_to_be_kept_is_in_no_table_and_no_count(tmp_path):
    with RunStore(tmp_path, settings()) as store:
        for ref in (A, B):
            store.write(ref, STATE, sample_tables(ref), 0.5)
        store.finish([B.key], [], 1.0)
    assert [entry["key"] for entry in manifest(tmp_path)] == [B.key]
    assert run_json(tmp_path)["counts"]["num_images"] == 2
    assert len(list(RunReader.open(tmp_path).rows("images", ["image_name"]))) == 2


def test_a_foreign_folder_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("x", encoding="utf-8")
    with pytest.raises(RunFolderError, match=r"is not a run folder and not empty \('thesis.tex' is in it\)"):
        RunStore(tmp_path, settings()).__enter__()
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("content", ["{}", "[]", "not json", '{"tool": "other", "config": {}, "paths": []}'])
def test_a_foreign_run_json_is_refused(tmp_path, content):
    (tmp_path / "run.json").write_text(content, encoding="utf-8")
    with pytest.raises(RunFolderError, match="not written by sfm-audit"):
        RunStore(tmp_path, settings()).__enter__()
    assert (tmp_path / "run.json").read_text(encoding="utf-8") == content


def test_a_folder_in_which_a_run_was_killed_at_once_is_taken(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / ".lock").touch()
    (tmp_path / ".tmp-run.json").write_bytes(b"{")
    (tmp_path / "images" / ".tmp-part-0.parquet").write_bytes(b"PAR1")
    write_run(tmp_path, [A])
    assert not list(tmp_path.rglob(".tmp-*"))


def test_one_run_at_a_time(tmp_path):
    with (
        RunStore(tmp_path, settings()),
        pytest.raises(RunFolderError, match="another run is writing here"),
        RunStore(tmp_path, settings()),
    ):
        pass
    write_run(tmp_path, [A])


def test_a_file_in_place_of_the_folder_is_an_output_error(tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "RUN"):
        with pytest.raises(OutputError, match="cannot be written"):
            RunStore(folder, settings()).__enter__()


def test_every_setting_fits_into_run_json(tmp_path):
    with RunStore(tmp_path, replace(settings(), config=AuditConfig().model_dump())):
        assert run_json(tmp_path)["config"] == AuditConfig().model_dump()
        assert run_json(tmp_path)["status"] == "running"


def test_the_metadata_of_a_part_does_not_change_its_rows(tmp_path):
    tables = sample_tables(A)
    with RunStore(tmp_path, settings()) as store:
        store.write(A, STATE, tables, 0.1)
    read = pa.parquet.ParquetFile(tmp_path / "images" / f"part-{A.key}.parquet").read()
    assert read.equals(tables["images"])


def test_any_name_stays_on_its_line_of_the_manifest(tmp_path):
    refs = [make_ref(f'data/ä\n{i}"\u2028/sparse/0', scene=f'ä{i}"\r') for i in range(3)]
    write_run(tmp_path, refs)
    assert sorted(item["scene"] for item in manifest(tmp_path)) == [ref.scene for ref in refs]
    assert sorted(row["scene"] for row in RunReader.open(tmp_path).rows("models", ["scene"])) == [r.scene for r in refs]
    write_run(tmp_path / "empty", [])
    assert manifest(tmp_path / "empty") == []
    assert list(RunReader.open(tmp_path / "empty").rows("images", ["scene"])) == []


def test_what_is_kept_of_a_finished_model_is_small(tmp_path):
    """A run may have 100,000 models: 1 kB each, not the config and the stamps that stand in every part."""
    refs = [make_ref(f"data/{i}/sparse/0", scene=str(i)) for i in range(50)]
    write_run(tmp_path, refs)
    with RunStore(tmp_path, settings()) as store:
        tracemalloc.start()
        assert all(store.finished(ref) for ref in refs)
        size, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert size / len(refs) < 1500


def test_the_mark_of_a_model_is_gone_from_the_disk_before_its_parts_are_written_again(tmp_path, monkeypatch):
    write_run(tmp_path, [A])
    flushed = []
    with RunStore(tmp_path, settings()) as store:
        for module in (store_module, disk):  # the mark's folder, and that of every file written
            monkeypatch.setattr(module, "flush_folder", lambda folder: flushed.append(folder.name))
        store.write(A, InputState(1, "new", "new"), sample_tables(A), 0.1)
    assert flushed[0] == "models"
    assert flushed[-1] == "models"


def part_of(folder: Path, table: str) -> Path:
    return folder / table / f"part-{A.key}.parquet"


def test_a_part_without_a_column_that_names_its_images_is_refused(tmp_path):
    write_run(tmp_path, [A])
    path = part_of(tmp_path, "images")
    pq.write_table(pq.ParquetFile(path).read().drop_columns(["image_name"]), path)
    forge_manifest(tmp_path)
    with pytest.raises(DamagedRunError, match="it has no column image_name"):
        list(RunReader.open(tmp_path).rows("images", ["scene", "image_name"]))


@pytest.mark.parametrize("lacks", ["code", "text"])
def test_a_finding_without_code_or_text_is_refused(tmp_path, lacks):
    write_run(tmp_path, [A])
    path = part_of(tmp_path, "models")
    table = pq.ParquetFile(path).read()
    field = table.schema.field("findings")
    findings = pa.array([[{"code": "c", "count": 1, "text": "t", lacks: None}]], field.type)
    pq.write_table(table.set_column(table.column_names.index("findings"), field, findings), path)
    forge_manifest(tmp_path)
    with pytest.raises(DamagedRunError, match="its column findings has a null"):
        list(RunReader.open(tmp_path).rows("models", ["findings"]))


def test_a_part_has_as_many_rows_as_its_line_says(tmp_path):
    write_run(tmp_path, [A])
    forge_manifest(tmp_path, lambda model: model["parts"]["images"].update(rows=3))
    with pytest.raises(DamagedRunError, match="2 rows, not 3"):
        list(RunReader.open(tmp_path).rows("images", ["scene"]))
