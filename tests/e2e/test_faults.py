"""Runs that are killed, lose workers, input or output: after the same command nothing is missing and nothing is double.

SFM_AUDIT_FAULTS sets how often each process is killed (once by default; 20 times takes a quarter of an hour).
"""

import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from audit_stubs import SECONDS
from process_tree import descendants, is_worker
from run_samples import copy_models, part_times, read_run, run_cli, start_cli, truncate, wait_for

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.dataset import DatasetSpec, write_dataset

KILLS = int(os.environ.get("SFM_AUDIT_FAULTS", "1"))
NUM_SCENES = 6
SECONDS_OF_A_RUN = 4.0  # with two processes on two quiet cores, rather more


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source") / "data"
    write_dataset(folder, DatasetSpec(NUM_SCENES, 24, linked=(200, 300), keypoints=400), 1)
    return folder


@pytest.fixture
def data(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return copy_models(source, tmp_path / "data")


@pytest.fixture(scope="module")
def expected(source, tmp_path_factory):
    """The rows of a run that nothing happens to."""
    folder = tmp_path_factory.mktemp("expected")
    shutil.copytree(source, folder / "data")
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert main(["run", "data", "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
    finally:
        os.chdir(before)
    return read_run(folder / "RUN")


def check(run: Path, expected) -> None:
    """Nothing is missing, nothing is double, nothing temporary is left."""
    got = read_run(run)
    for name, table in expected.items():
        assert got[name].equals(table), name
    for name in expected:
        assert len(list((run / name).iterdir())) == NUM_SCENES
    assert not list(run.rglob(".tmp-*"))


@pytest.mark.parametrize(
    "schedule", [("--jobs", "1"), ("--jobs", "2"), ("--jobs", "2", "--dask", "local")], ids=" ".join
)
@pytest.mark.parametrize("seed", range(KILLS))
@pytest.mark.usefixtures("data")
def test_the_command_is_killed_at_a_random_moment(expected, seed, schedule):
    if "--dask" in schedule:
        pytest.importorskip("distributed")
    moment = random.Random(seed).uniform(0.2, SECONDS_OF_A_RUN)  # noqa: S311
    with start_cli("run", "data", "-o", "RUN", *schedule) as process:
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            below = descendants(process.pid)
            process.kill()
            process.communicate()
            wait_for(lambda: not any(is_worker(pid) for pid in below), 30)
    if Path("RUN/models").is_dir():
        for part in Path("RUN/models").glob("part-*.parquet"):  # what is marked as finished is whole
            assert all(pq.ParquetFile(Path("RUN", name, part.name)).metadata.num_rows for name in expected)
    before = part_times(Path("RUN"))
    assert main(["run", "data", "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
    check(Path("RUN"), expected)
    after = part_times(Path("RUN"))
    finished = {name for name in before if name.startswith("models")}
    assert {name: after[name] for name in finished} == {name: before[name] for name in finished}


@pytest.mark.parametrize(
    "schedule", [("--jobs", "1"), ("--jobs", "2"), ("--jobs", "2", "--dask", "local")], ids=" ".join
)
@pytest.mark.parametrize("seed", range(KILLS))
@pytest.mark.usefixtures("data")
def test_parts_are_damaged_after_the_command_was_killed(expected, seed, schedule):
    """And once more while it is whole: what is intact stays, what is not is made again."""
    if "--dask" in schedule:
        pytest.importorskip("distributed")
    rng = random.Random(1000 + seed)  # noqa: S311
    with start_cli("run", "data", "-o", "RUN", *schedule, stub="slow") as process:
        wait_for(lambda: len(list(Path("RUN").glob("models/part-*.parquet"))) >= 2)
        below = descendants(process.pid)
        process.kill()
        process.communicate()
        wait_for(lambda: not any(is_worker(pid) for pid in below), 30)
    for _ in range(2):
        before = part_times(Path("RUN"))
        victim = rng.choice(sorted(before))
        content = Path("RUN", victim).read_bytes()
        other = Path("RUN", rng.choice([name for name in sorted(before) if name != victim]))
        Path("RUN", victim).write_bytes(rng.choice([b"", content[:-1], bytes(len(content)), other.read_bytes()]))
        assert main(["run", "data", "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
        check(Path("RUN"), expected)
        key = Path(victim).name
        after = part_times(Path("RUN"))
        finished = {Path(name).name for name in before if name.startswith("models")} - {key}
        assert all(after[name] == time for name, time in before.items() if Path(name).name in finished)
        assert after[victim] != before[victim]


@pytest.mark.parametrize("schedule", [("--jobs", "2"), ("--jobs", "2", "--dask", "local")], ids=" ".join)
@pytest.mark.parametrize("seed", range((KILLS + 1) // 2))
@pytest.mark.usefixtures("data")
def test_a_worker_is_killed_at_a_random_moment(expected, seed, schedule):
    if "--dask" in schedule:
        pytest.importorskip("distributed")
    rng = random.Random(seed)  # noqa: S311
    with start_cli("run", "data", "-o", "RUN", *schedule, stub="slow") as process:
        workers = wait_for(lambda: [pid for pid in descendants(process.pid) if is_worker(pid)])
        time.sleep(rng.uniform(0.0, NUM_SCENES * SECONDS / 2 + 2.0))
        workers = [pid for pid in descendants(process.pid) if is_worker(pid)] or workers
        with suppress(ProcessLookupError):  # the run was faster
            os.kill(rng.choice(workers), signal.SIGKILL)
        out, err = process.communicate(timeout=120)
    if "--dask" in schedule and process.returncode:  # it died before the cluster stood
        assert process.returncode == 2
        assert err.startswith("sfm-audit: --dask local: the workers did not start")
        assert err.count("\n") == 1
        assert main(["run", "data", "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
    else:
        assert (process.returncode, err) == (0, ""), out  # the others did not notice, and it was tried again
    check(Path("RUN"), expected)


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_scene_is_cut_short_during_the_run(data, expected, jobs):
    file = data / "0003/sparse/manhattan/0/points3D.bin"
    whole = file.read_bytes()
    with start_cli("run", "data", "-o", "RUN", "--jobs", jobs, stub="slow") as process:
        wait_for(lambda: list(Path("RUN/models").glob("part-*.parquet")))
        truncate(file)
        process.communicate(timeout=120)
    assert process.returncode in {0, 3}  # the scene may have been read before
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 3
    assert len(list(Path("RUN/models").iterdir())) == NUM_SCENES - 1
    file.write_bytes(whole)
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    check(Path("RUN"), expected)


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_the_output_folder_cannot_be_written_any_more(data, expected, jobs):
    del data
    with start_cli("run", "data", "-o", "RUN", "--jobs", jobs, stub="slow") as process:
        wait_for(lambda: list(Path("RUN/models").glob("part-*.parquet")))
        Path("RUN/images").rename("away")  # a file in its place: root ignores permissions
        Path("RUN/images").touch()
        _, err = process.communicate(timeout=120)
    assert process.returncode == 4
    assert err.count("\n") == 1
    assert "RUN/images" in err
    assert "cannot be written" in err
    Path("RUN/images").unlink()
    Path("away").rename("RUN/images")
    before = part_times(Path("RUN"))
    assert any(name.startswith("models") for name in before)
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    check(Path("RUN"), expected)
    assert all(part_times(Path("RUN"))[name] == time for name, time in before.items() if name.startswith("models"))


@pytest.mark.parametrize("kilobytes", [150, 300])
def test_the_disk_is_full(data, expected, kilobytes):
    del data
    run = Path("RUN")
    run.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", "RUN"]
    if shutil.which("mount") is None or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting a small file system is not allowed here")
    try:
        code, _, err = run_cli("run", "data", "-o", "RUN", "--jobs", "2")
        assert (code, err.count("\n")) == (4, 1)
        assert "No space left on device" in err
        before = part_times(run)
        finished = [name for name in before if name.startswith("models")]
        subprocess.run(["mount", "-o", "remount,size=100m", "RUN"], check=True)
        assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
        check(run, expected)
        assert all(part_times(run)[name] == before[name] for name in finished)
    finally:
        subprocess.run(["umount", "RUN"], check=True)
