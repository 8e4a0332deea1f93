"""One process writes into a run folder; the locks of processes that died are none."""

import errno
import json
import os
import platform
import subprocess
import sys

import pytest
from run_samples import TESTS, settings

from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.run_folder import lock as lock_module
from sfm_audit.reports.run_folder.lock import LockedError, RunLock
from sfm_audit.reports.run_folder.store import RunStore

HOLD = """
import sys
from pathlib import Path
from sfm_audit.reports.run_folder import lock
{patch}
lock.RunLock(Path(sys.argv[1])).acquire()
print("held", flush=True)
sys.stdin.read()
"""
NO_FLOCK = """
def refuse(handle):
    raise OSError(38, "Function not implemented")
lock._lock = refuse
"""


@pytest.fixture(params=[True, False], ids=["flock", "no flock"])
def has_flock(request, monkeypatch):
    if not request.param:

        def refuse(_: int) -> bool:
            raise OSError(errno.ENOSYS, "Function not implemented")

        monkeypatch.setattr(lock_module, "_lock", refuse)
    return request.param


def hold(folder, has_flock) -> subprocess.Popen[str]:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parent), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", HOLD.format(patch="" if has_flock else NO_FLOCK), str(folder)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.usefixtures("has_flock")
def test_a_lock_is_held_by_one_and_left_by_none(tmp_path):
    one, two = RunLock(tmp_path), RunLock(tmp_path)
    for _ in range(2):
        one.acquire()
        with pytest.raises(LockedError, match=f"process {os.getpid()}"):
            two.acquire()
        one.release()
        two.acquire()
        two.release()
    assert all(path.read_bytes() == b"" for path in tmp_path.iterdir())


def test_a_process_that_was_killed_holds_nothing(tmp_path, has_flock):
    with hold(tmp_path, has_flock) as process:
        with pytest.raises(RunFolderError, match=rf"another run is writing here \(process {process.pid}\); wait, or"):
            RunStore(tmp_path, settings()).__enter__()
        process.kill()
        process.communicate()
    with RunStore(tmp_path, settings()):
        pass


def test_a_process_with_the_number_of_one_that_died_is_another(tmp_path, monkeypatch):
    monkeypatch.setattr(lock_module, "_lock", lambda _: (_ for _ in ()).throw(OSError(errno.ENOLCK, "no locks")))
    owner = tmp_path / ".lock-owner"
    mine = {"host": platform.node(), "pid": os.getppid(), "started": lock_module._started(os.getppid())}
    owner.write_text(json.dumps(mine))
    with pytest.raises(LockedError):
        RunLock(tmp_path).acquire()
    owner.write_text(json.dumps({**mine, "started": "another boot 17"}))
    RunLock(tmp_path).acquire()
    assert json.loads(owner.read_text())["pid"] == os.getpid()


@pytest.mark.parametrize(
    "text", ['{"host": "elsewhere", "pid": 1, "started": "x"}', "", "garbage", '{"pid": "x"}', "[" * 9000]
)
def test_of_another_machine_nobody_knows(tmp_path, monkeypatch, text):
    monkeypatch.setattr(lock_module, "_lock", lambda _: (_ for _ in ()).throw(OSError(errno.ENOLCK, "no locks")))
    (tmp_path / ".lock-owner").write_text(text)
    with pytest.raises(LockedError, match="on elsewhere" if "elsewhere" in text else "remove that file if none runs"):
        RunLock(tmp_path).acquire()
    assert (tmp_path / ".lock-owner").read_text() == text
