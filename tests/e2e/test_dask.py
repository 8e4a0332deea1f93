"""sfm-audit run --dask as a user meets it: what it listens on, what it says when there is no cluster, and an end."""

import importlib.util
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from process_tree import descendants, is_worker
from run_samples import read_run, run_cli, start_cli, wait_for, write_models

from sfm_audit.audit.cli.main import main

pytest.importorskip("distributed")


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_models(tmp_path / "data", ["a", "b", "deadly"])
    return tmp_path / "data"


def listening(pid: int) -> set[str]:
    """Return local addresses on which a process and those below it listen, as /proc has them."""
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
    inodes = set()
    for each in (pid, *descendants(pid)):
        with suppress(OSError):  # it may have ended by now
            inodes |= {str(f.readlink()).removeprefix("socket:[")[:-1] for f in Path(f"/proc/{each}/fd").iterdir()}
    return {row[1] for row in rows if row[3] == "0A" and row[9] in inodes}


@pytest.mark.usefixtures("data")
def test_a_local_cluster_listens_on_loopback_alone_and_ends_with_the_run():
    seen, processes = set(), set()
    with start_cli("run", "data", "-o", "RUN", "--jobs", "2", "--dask", "local", "--quiet", stub="slow") as process:
        while process.poll() is None:
            seen |= listening(process.pid)
            processes |= set(descendants(process.pid))
            time.sleep(0.05)
        assert process.communicate() == ("", "")
    assert process.returncode == 0
    assert len(seen) >= 3  # scheduler, two workers
    assert all(address.startswith("0100007F:") for address in seen)
    assert not any(address.endswith(":2253") for address in seen)  # 8787, where dashboards are
    wait_for(lambda: not any(is_worker(pid) for pid in processes), 30)
    assert len(list(Path("RUN/models").iterdir())) == 3


def test_a_cluster_that_was_started_elsewhere(data):
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    worker = ["distributed.cli.dask_worker", address, "--nthreads", "2", "--no-dashboard", "--host", "127.0.0.1"]
    with subprocess.Popen([sys.executable, "-m", *scheduler], **quiet) as one:
        try:
            with subprocess.Popen([sys.executable, "-m", *worker], **quiet) as two:
                try:
                    assert run_cli("run", data, "-o", "RUN", "--dask", address, "--quiet") == (0, "", "")
                finally:
                    two.terminate()
        finally:
            one.terminate()
    assert main(["run", str(data), "-o", "SERIAL", "--jobs", "1", "--quiet"]) == 0
    got, expected = read_run(Path("RUN")), read_run(Path("SERIAL"))
    assert all(got[name].equals(expected[name]) for name in expected)


@pytest.mark.usefixtures("data")
def test_a_model_that_kills_its_worker_is_a_failure_and_the_others_are_not():
    code, _, err = run_cli("run", "data", "-o", "RUN", "--jobs", "2", "--dask", "local", "--quiet", stub="die")
    assert code == 5
    assert err.count("\n") == 1
    assert "deadly/sparse/0: the process that audited it died twice" in err
    assert len(list(Path("RUN/models").iterdir())) == 2


@pytest.mark.usefixtures("data")
def test_no_scheduler_is_2(monkeypatch, capsys):
    monkeypatch.setattr("sfm_audit.audit.schedule.cluster._CONNECT_SECONDS", 1)
    for address in (f"tcp://127.0.0.1:{free_port()}", "nonsense"):
        assert main(["run", "data", "-o", "RUN", "--dask", address]) == 2
        err = capsys.readouterr().err
        assert f"--dask {address}" in err
        assert err.count("\n") == 1


@pytest.mark.usefixtures("data")
def test_without_the_extra_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert main(["run", "data", "-o", "RUN", "--dask", "local"]) == 2
    assert "pip install 'sfm-audit[cluster]'" in capsys.readouterr().err
    assert not Path("RUN").exists()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])
