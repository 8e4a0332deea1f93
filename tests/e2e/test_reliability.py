"""The promises of docs/reliability.md about runs, run folders and signals, as a user meets them."""

import json
import os
import shutil
import signal
import socket
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pycolmap
import pytest
from process_tree import descendants, is_worker
from run_damage import forge_manifest
from run_samples import part_times, read_run, run_cli, start_cli, truncate, wait_for, write_models

from sfm_audit.audit.cli.main import main

NAMES = ("a", "broken", "z")
SCHEDULES = [("--jobs", "1"), ("--jobs", "2"), ("--jobs", "2", "--dask", "local")]


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_models(tmp_path / "data", NAMES)
    return tmp_path / "data"


def failures() -> list[dict]:
    return json.loads(Path("RUN/run.json").read_text())["failures"]


def scenes() -> set[str]:
    return set(pd.read_parquet("RUN/models")["scene"])


@pytest.mark.parametrize("schedule", SCHEDULES, ids=" ".join)
@pytest.mark.parametrize("bug", ["break_down", "run_out_of_memory", "recurse"])
def test_a_bug_costs_one_model_one_line_and_5(schedule, bug):
    if "--dask" in schedule:
        pytest.importorskip("distributed")
    code, out, err = run_cli("run", "data", "-o", "RUN", *schedule, stub=bug)
    assert code == 5
    assert err.count("\n") == 1, err
    assert err.startswith("sfm-audit: data/broken/sparse/0: ")
    assert "Not audited" in out
    assert scenes() == {"a", "z"}
    (failure,) = failures()
    assert failure["kind"] == ("memory" if bug == "run_out_of_memory" else "error")
    assert f"(RUN/{failure['report']})" in err
    report = Path("RUN", failure["report"]).read_text()
    assert "Traceback (most recent call last)" in report
    assert f"in {bug}" in report
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0  # the bug is fixed
    assert scenes() == set(NAMES)
    assert list(Path("RUN/errors").iterdir()) == []


def test_of_several_exit_codes_the_highest_is_returned(data):
    truncate(data / "a/sparse/0/points3D.bin")
    code, _, err = run_cli("run", "data", "nothing", "-o", "RUN", "--jobs", "1", stub="break_down")
    assert (code, err.count("\n")) == (5, 3)
    assert sorted(failure["kind"] for failure in failures()) == ["error", "unreadable", "unreadable"]
    with start_cli("run", "data", "-o", "NEW", "--jobs", "1", "--quiet", stub="break_down") as process:
        wait_for(lambda: list(Path("NEW/errors").glob("*.txt")))
        shutil.rmtree("NEW/models", ignore_errors=True)
        with suppress(FileExistsError):
            Path("NEW/models").touch()
        _, err = process.communicate(timeout=60)
    assert process.returncode == 5, err  # the output failed too, which is 4


@pytest.mark.parametrize("jobs", ["1", "2"])
@pytest.mark.parametrize(
    ("stub", "option", "kind"),
    [
        ("sleep", ("--max-model-seconds", "10"), "time"),
        ("fill_memory", ("--max-model-memory", "0.8"), "memory"),
    ],
)
def test_a_model_beyond_a_limit_costs_one_line_and_5(jobs, stub, option, kind):
    with start_cli("run", "data", "-o", "RUN", "--quiet", "--jobs", jobs, *option, stub=stub) as process:
        out, err = process.communicate(timeout=100)
        assert not descendants(process.pid)
    assert (process.returncode, out, err.count("\n")) == (5, "", 1), err
    assert err.startswith("sfm-audit: data/broken/sparse/0: its audit was ended at ")
    assert option[0] in err
    assert scenes() == {"a", "z"}
    assert [failure["kind"] for failure in failures()] == [kind]


def test_a_limit_holds_on_dask_workers_too():
    pytest.importorskip("distributed")
    options = ("--jobs", "2", "--dask", "local", "--max-model-seconds", "15", "--quiet")
    code, _, err = run_cli("run", "data", "-o", "RUN", *options, stub="sleep")
    assert (code, err.count("\n")) == (5, 1), err
    assert scenes() == {"a", "z"}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_signal_that_ends_is_one_line_and_the_run_goes_on(number, code, jobs):
    with start_cli("run", "data", "-o", "RUN", "--jobs", jobs, stub="sleep", start_new_session=True) as process:
        wait_for(lambda: list(Path("RUN/models").glob("part-*.parquet")))
        workers = [pid for pid in descendants(process.pid) if is_worker(pid)]
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err.count("\n")) == (code, "", 1), err
    assert f"sfm-audit: ended by {number.name}; what was finished stays, the same command goes on" in err
    wait_for(lambda: not any(is_worker(pid) for pid in workers), 30)
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    assert scenes() == set(NAMES)


def test_a_run_that_ignores_the_end_of_its_terminal_goes_on():
    def ignore() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does

    with start_cli("run", "data", "-o", "RUN", "--jobs", "1", "--quiet", stub="slow", preexec_fn=ignore) as process:
        wait_for(lambda: Path("RUN/run.json").exists())
        process.send_signal(signal.SIGHUP)
        assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == 0


def test_verify_finds_what_size_and_time_hide(data):
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    before = part_times(Path("RUN"))
    file = data / "a/sparse/0/images.bin"
    stat, content = file.stat(), bytearray(file.read_bytes())
    content[20] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    assert part_times(Path("RUN")) == before
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1", "--verify"]) == 0
    assert sum(before[name] != time for name, time in part_times(Path("RUN")).items()) == 3


class Listener:
    """A host that counts who calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                caller, _ = self._socket.accept()
                caller.settimeout(2)
                with caller, suppress(OSError):
                    self.calls.append(caller.recv(4096).decode(errors="replace"))
                    caller.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")

    def close(self) -> None:
        self._socket.close()


def test_a_stranger_s_run_folder_makes_no_request(monkeypatch):
    """However well it hangs together; what the command line names is asked, with the options of the command line."""
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "AKIAVICTIM")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    assert main(["run", "data/a", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    listener = Listener()
    options = f"?endpoint_override=127.0.0.1:{listener.port}&scheme=http"
    location = f"s3://bucket/model{options}"
    for path in Path("RUN").glob("*/*.parquet"):
        table = pq.ParquetFile(path).read()
        i = table.schema.get_field_index("model_path")
        pq.write_table(table.set_column(i, table.schema.field(i), pa.array([location] * len(table))), path)
    forge_manifest(Path("RUN"), lambda model: model.update(model_path=location))
    info = json.loads(Path("RUN/run.json").read_text())
    Path("RUN/run.json").write_text(json.dumps({**info, "paths": [{"given": location, "real": location}]}))
    report = ["report", "RUN", "-o", "page.html", "--quiet", "--force", "--worst", "1"]
    for verb in (
        report,
        [*report, "--model", "s3://other/model"],
        ["check", "RUN", "--policy-file", "/dev/null"],
        ["filter", "RUN", "--list", "list.txt"],
        ["filter", "RUN", "--model", "data/a/sparse/0", "--model-out", "pruned"],
        ["diff", "RUN", "RUN"],
        ["run", "data/a", "-o", "RUN", "--quiet"],
    ):
        assert main(verb) in {0, 2}, verb
    assert listener.calls == []
    assert "is not opened because a run folder says so" in Path("page.html").read_text()
    assert main([*report, "--model", f"s3://bucket{options}"]) == 0
    assert any("model" in call for call in listener.calls)
    listener.close()


def test_an_image_s_name_that_another_has_is_ambiguous(data, capsys):
    folder = data / "a/sparse/0"
    model = pycolmap.Reconstruction(folder)
    ids = sorted(model.images)
    for image_id in ids[:3]:
        model.images[image_id].name = "same.jpg"
    model.write(str(folder))
    assert main(["explain", str(folder), "same.jpg", "-o", "story"]) == 2
    err = capsys.readouterr().err
    assert f"has 3 images called 'same.jpg'; name one by its id (id:{ids[0]}, id:{ids[1]}, id:{ids[2]} ...)" in err
    assert not Path("story").exists()
    assert main(["explain", str(folder), f"id:{ids[1]}", "-o", "story", "--quiet"]) == 0


def test_a_full_disk_under_a_filtered_model_is_4_and_names_it(data):
    assert main(["run", "data/a", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    Path("small").mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k", "tmpfs", "small"]
    if shutil.which("mount") is None or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting a small file system is not allowed here")
    try:
        code, _, err = run_cli("filter", "RUN", "--model", data / "a/sparse/0", "--model-out", "small/pruned")
        assert (code, err.count("\n")) == (4, 1), err
        assert err.startswith("sfm-audit: small/pruned: cannot be written (")
        assert ".tmp" not in err
        assert list(Path("small").iterdir()) == []
    finally:
        subprocess.run(["umount", "small"], check=True)


@pytest.mark.parametrize("kind", ["pipe", "zero"])
def test_special_files_are_never_waited_for(kind):
    for name in ("gate.toml", "STRANGE/run.json"):
        Path(name).parent.mkdir(exist_ok=True)
        if kind == "pipe":
            os.mkfifo(name)
        else:
            Path(name).symlink_to("/dev/zero")
    assert main(["run", "data/a", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    assert run_cli("run", "data", "-o", "OTHER", "--config", "gate.toml")[0] == 2
    assert run_cli("check", "RUN", "--policy-file", "gate.toml")[0] == 2
    assert run_cli("check", "STRANGE", "--policy-file", "/dev/null")[0] == 3
    assert run_cli("run", "data", "-o", "STRANGE")[0] == 2


def test_rows_are_the_same_whoever_made_them_anew():
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    expected = read_run(Path("RUN"))
    parts = sorted(Path("RUN").glob("*/part-*.parquet"))
    for path in parts[::2]:
        path.write_bytes(path.read_bytes()[:-9])
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "2"]) == 0
    assert all(read_run(Path("RUN"))[name].equals(table) for name, table in expected.items())
