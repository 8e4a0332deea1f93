"""Stand-ins for audit.runner.audit_one that are slow, die or fail; worker processes import them by name."""

import os
import time
from pathlib import Path

from audit.runner import Outcome, Task, audit_one

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
