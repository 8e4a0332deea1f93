"""The campaign of damaged inputs (scripts/fuzz.py), a few hundred of it, and that it sees what it looks for."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.fuzzing import run_folders, workers
from scripts.fuzzing.cases import MODELS, Case, file_case, model_case, write_case
from scripts.fuzzing.edits import Edit
from scripts.fuzzing.outcomes import Outcome
from scripts.fuzzing.targets import TARGETS, attempt
from scripts.fuzzing.workers import Worker

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("target", "first"), [("models", 0), ("files", 10_000), ("run folders", 20_000)])
def test_some_of_a_campaign(target: str, first: int):
    draw = TARGETS[target].draw
    bad = [
        (case, outcome)
        for case in (draw(7, first + i) for i in range(8 if target == "run folders" else 250))
        if not (outcome := attempt(target, case)).is_good
    ]
    assert bad == []


def test_sound_inputs_are_sound():
    for base in MODELS:
        for layout in ("binary", "text"):
            wanted = "finding" if base == "rig" else "ok"  # the poses in its images file are not those of the rig
            assert attempt("models", Case(0, base, layout, ())).kind == wanted, (base, layout)
    for base in ("csv", "parquet", "ptx", "pickle2", "pickle4", "npz", "database"):
        assert attempt("files", Case(0, base, "", ())).kind == "ok", base


def test_an_input_is_the_same_every_time(tmp_path: Path):
    for number, draw in enumerate([model_case, file_case] * 5):
        assert draw(3, number) == draw(3, number)
        contents = []
        for copy in ("a", "b"):
            folder = tmp_path / f"{number}{copy}"
            folder.mkdir()
            write_case(draw(3, number), folder)
            contents.append({path.name: path.read_bytes() for path in folder.iterdir()})
        assert contents[0] == contents[1]
    assert len({model_case(3, number).edits for number in range(50)}) > 45


def test_a_list_that_differs_in_silence_is_seen():
    case = Case(0, "damaged run", "", (Edit("readers", "1"),))
    assert attempt("run folders", case).kind == "ok"
    (run_folders._sound() / "all.txt").write_text("another.jpg\n")
    found = attempt("run folders", case)
    run_folders._sound.cache_clear()
    assert found.kind == "SILENT"


def fill(_case: Case, _folder: Path) -> Outcome:
    bytearray(8 << 30)
    return Outcome("ok")


def limited(pipe) -> None:
    """What a worker does with an input that takes too much memory, in a process of its own."""
    workers._prepare(1 << 30)
    try:
        fill(Case(0, "tiny", "binary", ()), Path())
    except MemoryError:
        pipe.send("MemoryError")


def test_memory_is_limited():
    here, there = workers._CONTEXT.Pipe()
    process = workers._CONTEXT.Process(target=limited, args=(there,))
    process.start()
    assert here.poll(60)
    assert here.recv() == "MemoryError"
    process.join()


def test_a_worker_that_dies_or_hangs_costs_its_input_alone():
    worker = Worker(memory_bytes=1 << 30, seconds=20.0)
    try:
        assert worker.attempt("models", Case(0, "tiny", "binary", ())).kind == "ok"
        worker._process.kill()
        worker._process.join()
        assert worker.attempt("models", Case(0, "tiny", "binary", ())).kind == "CRASH"
        assert worker.attempt("models", Case(0, "tiny", "binary", ())).kind == "ok"
        worker._seconds = 0.0
        assert worker.attempt("models", Case(0, "tiny", "binary", ())).kind == "HANG"
        worker._seconds = 20.0
        cut = Case(0, "tiny", "binary", (Edit("cut", "images.bin", 5),))
        assert worker.attempt("models", cut).kind == "refused"
    finally:
        worker.stop()


def test_the_record_counts_pycolmap_s_answers_beside_ours(tmp_path: Path):
    record = tmp_path / "record.json"
    command = [sys.executable, ROOT / "scripts" / "fuzz.py", "--only", "4", "--target", "models", "--record", record]
    assert subprocess.run(command, check=False, capture_output=True, timeout=120).returncode == 0
    found = json.loads(record.read_text())
    assert found["inputs"] == 1
    assert sum(found["beside_pycolmap"].values()) == 1
    assert found["failures"] == found["silent"] == []


KNOWN = {
    "the sizes of a damaged column": ("parquet", [("delete", 677, "2"), ("flip", 826, "1")]),
    "a length that an archive makes up": ("npz", [("put", 588, "11ea2d819997713d")]),
    "a transformation beyond all numbers": ("ptx", [("token", 24, "3165333038")]),
    "columns of different lengths": ("parquet", [("flip", 1052, "5")]),
    "a NaN that signals": ("database", [("flip", 24223, "6"), ("flip", 24221, "0")]),
}


@pytest.mark.parametrize("what", KNOWN)
def test_what_the_campaign_found_stays_refused(what: str):
    """A crash of pyarrow, a MemoryError, warnings, a ValueError: numbers 216796, 204809, 219894, 239940 of seed 11."""
    base, edits = KNOWN[what]
    case = Case(0, base, "", tuple(Edit(kind, base, at, value) for kind, at, value in edits))
    assert attempt("files", case).kind == ("ok" if base == "database" else "refused")


def test_a_row_that_a_search_does_not_find_is_told():
    """Number 1177 of seed 21: a page of the table of keypoints points elsewhere."""
    case = Case(1177, "database", "", (Edit("put", "database", 18534, "ffffffff00000000"),))
    assert attempt("files", case).kind == "refused"
