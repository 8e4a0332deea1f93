"""Stand-ins for audit.schedule.task.audit_one that are slow, die or fail; worker processes import them by name."""

import os
import signal
import stat
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from sfm_audit.audit.engine import model as engine
from sfm_audit.audit.schedule import lanes
from sfm_audit.audit.schedule.runner import Outcome, Task, audit_one

SECONDS = 0.4


def slow(task: Task) -> Outcome:
    time.sleep(SECONDS)
    return audit_one(task)


def stuck(task: Task) -> Outcome:
    """Take a minute for the last of the four models of tests/e2e/test_run.py."""
    if task.ref.scene == "a name with spaces":
        time.sleep(60)
    return audit_one(task)


def die(task: Task) -> Outcome:
    """Die on models of the scene called deadly, each time."""
    if task.ref.scene == "deadly":
        os._exit(9)
    return audit_one(task)


def die_once(task: Task) -> Outcome:
    """Die on the first model of the scene called deadly, the first time."""
    mark = Path(task.ref.location) / "died"
    if task.ref.scene == "deadly" and not mark.exists():
        mark.touch()
        os._exit(9)
    return audit_one(task)


def break_down(task: Task) -> Outcome:
    """Raise an error nobody expects on models of the scene called broken."""
    if task.ref.scene == "broken":
        raise ZeroDivisionError("a bug")
    return audit_one(task)


def run_out_of_memory(task: Task) -> Outcome:
    """Raise MemoryError on models of the scene called broken."""
    if task.ref.scene == "broken":
        raise MemoryError
    return audit_one(task)


def recurse(task: Task) -> Outcome:
    """Call itself without end on models of the scene called broken."""
    return recurse(task) if task.ref.scene == "broken" else audit_one(task)


def fail_in_three_ways(task: Task) -> Outcome:
    """Raise another error nobody expects on models of the scenes broken, deadly and z."""
    fails = {"broken": break_down, "deadly": run_out_of_memory, "z": recurse}.get(task.ref.scene)
    return audit_one(task) if fails is None else fails(replace(task, ref=replace(task.ref, scene="broken")))


def sleep(task: Task) -> Outcome:
    """Take a minute on models of the scene called broken."""
    if task.ref.scene == "broken":
        time.sleep(60)
    return audit_one(task)


def fill_memory(task: Task) -> Outcome:
    """Take 3 GB, and keep them, on models of the scene called broken."""
    if task.ref.scene == "broken":
        held = [bytearray(b"x" * 50_000_000) for _ in range(60)]
        time.sleep(30)
        held.clear()
    return audit_one(task)


def lose_an_image_process(task: Task, mark: Path) -> Outcome:
    """Let one of the processes die over which the images are spread."""
    facts_of = engine._quality_of
    if task.num_processes > 1:
        engine._quality_of = partial(_die_over_images, mark=mark)
    try:
        return audit_one(task)
    finally:
        engine._quality_of = facts_of


def _die_over_images(_: object, image_idxs: range, mark: Path) -> list[None]:
    if image_idxs.start == 0:
        mark.touch()
        os._exit(9)
    return [None] * len(image_idxs)


def send_half_an_answer() -> None:
    """Begin to answer as Connection.send does, with the length of what follows, and be killed."""
    for number in range(3, 64):
        with suppress(OSError):
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                os.write(number, (1000).to_bytes(4, "big") + b"half")
    os.kill(os.getpid(), signal.SIGKILL)


_asked: list[dict[str, bool]] = []


def given_back() -> list[dict[str, bool]]:
    """How this worker process was asked to give memory back since it was first asked here."""
    lanes.give_back = lambda **how: _asked.append(how)
    return _asked
