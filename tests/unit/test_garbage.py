"""Importing without collecting: the collector is as before afterwards, and garbage does not stay for good."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator

import pytest

from sfm_audit.audit.schedule.garbage import importing, leaving

UNUSUAL = "this"  # a module of the standard library that nobody imports; it prints a poem


@pytest.fixture(autouse=True)
def unfrozen() -> Iterator[None]:
    yield
    gc.unfreeze()
    gc.enable()


def test_what_was_imported_is_not_walked_again() -> None:
    gc.unfreeze()
    sys.modules.pop(UNUSUAL, None)
    with importing():
        assert not gc.isenabled()
        __import__(UNUSUAL)
    assert gc.isenabled()
    assert gc.get_freeze_count() > 0


def test_garbage_is_not_kept_where_nothing_was_imported() -> None:
    gc.unfreeze()
    with importing():
        __import__("sys")
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_failed_import_turns_the_collector_on_again() -> None:
    with pytest.raises(ModuleNotFoundError), importing():
        __import__("no_such_module_anywhere")
    assert gc.isenabled()


def test_whoever_works_without_a_collector_keeps_working_without() -> None:
    gc.disable()
    with importing():
        pass
    assert not gc.isenabled()


def test_leaving_takes_everything_out_of_the_collectors_sight() -> None:
    gc.unfreeze()
    leaving()
    assert gc.get_freeze_count() > 1000
