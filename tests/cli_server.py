"""sfm-audit in processes that are forked, not started: cheap, each with limits of its own, and asked for its memory.

with CliServer() as cli:
    answer = cli("check", "RUN", "--policy-file", "gate.toml", cwd=folder)
"""

import importlib
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

GIGABYTE = 2**30
PRELOADED = ("auditing", "check", "diagnose", "diff", "explain", "filter", "image_story", "report_page", "run")


@dataclass(frozen=True)
class Answer:
    """What a command did; code is None if it did not end in time, negative if a signal ended it."""

    code: int | None
    out: str
    err: str
    more_mb: float  # resident memory beyond what was there before it began


class CliServer:
    """A process with everything imported that forks once per command."""

    def __enter__(self) -> Self:
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        env = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen([sys.executable, __file__], text=True, env=env, **streams)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def __call__(
        self,
        *args: str | Path,
        cwd: str | Path = ".",
        env: Mapping[str, str] | None = None,
        seconds: float = 60.0,
        address_space: float = 6.0,
        kill_at: int | None = None,
    ) -> Answer:
        """Run one command; address_space in GB; kill_at: it dies before so many renamings and flushings of files."""
        request = {"args": [os.fspath(arg) for arg in args], "cwd": os.path.abspath(cwd), "env": dict(env or {})}  # noqa: PTH100
        request |= {"kill_at": kill_at, "seconds": seconds, "address_space": int(address_space * GIGABYTE)}
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return Answer(**json.loads(self._process.stdout.readline()))


def serve() -> None:
    """Answer one request per line of stdin."""
    for name in PRELOADED:
        importlib.import_module(f"sfm_audit.audit.cli.{name}")
    for line in sys.stdin:
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            pid = os.fork()
            if not pid:
                _become(json.loads(line), out.fileno(), err.fileno())
            answer = _wait(pid, json.loads(line)["seconds"])
            for name, file in (("out", out), ("err", err)):
                file.seek(0)
                answer[name] = file.read().decode(errors="backslashreplace")
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _become(request: dict[str, Any], out: int, err: int) -> None:
    """Be the command in the child, and never return."""
    code = 1
    try:
        os.setsid()
        for source, target in ((os.open(os.devnull, os.O_RDONLY), 0), (out, 1), (err, 2)):
            os.dup2(source, target)
        os.chdir(request["cwd"])
        os.environ.update(request["env"])
        resource.setrlimit(resource.RLIMIT_AS, (request["address_space"],) * 2)
        sys.argv = ["sfm-audit", *request["args"]]
        if request["kill_at"] is not None:
            _die_at(request["kill_at"])
        from sfm_audit.audit.cli.main import entry_point  # noqa: PLC0415 - imported already

        entry_point()
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:  # noqa: BLE001 - a test looks for it
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _die_at(number: int) -> None:
    """Kill this process before the renaming or flushing of that number, counted from 0."""
    left = itertools.count(number, -1)

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def or_die(*args: Any, **options: Any) -> Any:
            if next(left) == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args, **options)

        return or_die

    Path.replace = dying(Path.replace)
    os.fsync = dying(os.fsync)


def _wait(pid: int, seconds: float) -> dict[str, Any]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    end = time.monotonic() + seconds
    late = False
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end and not late:
            late = True
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.003)
    code = None if late else os.waitstatus_to_exitcode(status)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return {"code": code, "more_mb": max(0, usage.ru_maxrss - before) / unit}


if __name__ == "__main__":
    serve()
