import os
import threading
from dataclasses import replace
from pathlib import Path

import audit_stubs
import pytest
import threadpoolctl
from run_samples import write_models

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.kernels.threads import threads
from sfm_audit.audit.schedule import task as task_module
from sfm_audit.audit.schedule.runner import Failure, Limits, audit_many, audit_one
from sfm_audit.loaders import LoadError, discover
from sfm_audit.loaders.datasets.input_state import InputState, input_stamp, read_input_state


class Memory:
    """A sink that keeps everything in a dict."""

    def __init__(self) -> None:
        self.states: dict[str, InputState] = {}
        self.tables = {}
        self.dropped = []
        self.reports = {}

    def finished(self, ref):
        return self.states.get(ref.key)

    def write(self, ref, state, tables, seconds, computed_by=""):
        assert seconds > 0
        assert computed_by
        self.states[ref.key] = state
        self.tables[ref.key] = tables

    def drop(self, key):
        self.dropped.append(key)

    def keep_report(self, ref, text):
        self.reports[ref.key] = text


@pytest.fixture
def refs(tmp_path):
    write_models(tmp_path / "data", ["a", "broken", "deadly", "z"])
    return discover([tmp_path / "data"]).refs


def run(refs, sink, jobs=1, audit=audit_one):
    done = []
    failures = audit_many(refs, AuditConfig(), jobs=jobs, sink=sink, on_done=done.append, audit=audit)
    assert sorted(ref.key for ref in done) == sorted(ref.key for ref in refs)
    return failures


def test_processes_give_the_tables_of_one_process(refs):
    one, two = Memory(), Memory()
    assert run(refs, one) == []
    assert run(refs, two, jobs=2) == []
    assert one.tables.keys() == two.tables.keys() == {ref.key for ref in refs}
    for key, tables in one.tables.items():
        assert all(tables[name].equals(two.tables[key][name]) for name in ("images", "cameras", "models"))


@pytest.mark.parametrize("jobs", [1, 2])
def test_models_that_cannot_be_read_are_failures_in_the_order_given(refs, jobs):
    for ref in (refs[3], refs[1]):
        Path(ref.location, "images.bin").write_bytes(b"short")
    sink = Memory()
    failures = run(refs, sink, jobs)
    assert [failure.location for failure in failures] == [refs[1].model_path, refs[3].model_path]
    assert all("images.bin" in failure.message and "\n" not in failure.message for failure in failures)
    assert sorted(sink.dropped) == sorted([refs[1].key, refs[3].key])
    assert len(sink.tables) == 2


def test_failures_are_told_in_the_order_given_whatever_finishes_first(refs, monkeypatch):
    for ref in refs[:3]:
        Path(ref.location, "images.bin").write_bytes(b"short")
    backwards = lambda tasks, audit: ((task, audit(task)) for task in reversed(tasks))  # noqa: E731
    monkeypatch.setattr("sfm_audit.audit.schedule.runner._in_this_process", backwards)
    assert [failure.location for failure in run(refs, Memory())] == [ref.model_path for ref in refs[:3]]


def test_a_model_whose_process_dies_twice_is_a_failure_and_the_others_are_not(refs):
    sink = Memory()
    (failure,) = run(refs, sink, jobs=2, audit=audit_stubs.die)
    assert isinstance(failure, Failure)
    assert failure.location.endswith("deadly/sparse/0")
    assert "died twice" in failure.message
    assert "(exit code 9)" in failure.message
    assert Path(refs[2].location).exists()
    assert len(sink.tables) == 3


def test_a_model_whose_process_dies_once_is_tried_again(refs):
    sink = Memory()
    assert run(refs, sink, jobs=2, audit=audit_stubs.die_once) == []
    assert len(sink.tables) == 4


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_nobody_expects_costs_its_model_alone(refs, jobs):
    sink = Memory()
    told = []
    audit = audit_stubs.fail_in_three_ways
    failures = audit_many(refs, AuditConfig(), jobs=jobs, sink=sink, audit=audit, on_failure=told.append)
    assert sorted(told, key=failures.index) == failures
    assert list(sink.tables) == [refs[0].key]
    expected = (
        ("break_down", "error", "a bug ended its audit (ZeroDivisionError: a bug)"),
        ("run_out_of_memory", "memory", "memory was too short to audit it (MemoryError)"),
        ("recurse", "error", "a bug ended its audit (RecursionError: maximum recursion depth exceeded"),
    )
    for ref, failure, (name, kind, said) in zip(refs[1:], failures, expected, strict=True):
        assert (failure.location, failure.kind) == (ref.model_path, kind)
        assert failure.message.startswith(f"{ref.model_path}: {said}")
        assert "\n" not in failure.message
        report = sink.reports[ref.key]
        for words in ("Traceback", f"in {name}", "sfm-audit 0.", "pycolmap ", ref.model_path, '"alpha":0.05'):
            assert words in report
        assert report.count("\n") < 200


def test_a_model_that_memory_is_too_short_to_read_is_an_input_that_cannot_be_read(refs, monkeypatch):
    read = task_module.open_model

    def open_model(location: str):
        if "broken" in location:
            raise MemoryError
        return read(location)

    monkeypatch.setattr(task_module, "open_model", open_model)
    (failure,) = run(refs, Memory())
    assert (failure.location, failure.kind, failure.report) == (refs[1].model_path, "too_large", None)
    assert "memory was too short to read its " in failure.message


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_what_asks_for_the_end_is_no_model_s_failure(refs, error):
    def end(_: object):
        raise error

    with pytest.raises(error):
        audit_many(refs, AuditConfig(), jobs=1, sink=Memory(), audit=end)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_model_that_takes_too_long_is_ended_and_the_others_are_not(refs, jobs):
    sink = Memory()
    limits = Limits(seconds=5.0)  # the others take a tenth of a second each
    (failure,) = audit_many(refs, AuditConfig(), jobs=jobs, sink=sink, audit=audit_stubs.sleep, limits=limits)
    assert (failure.location, failure.kind) == (refs[1].model_path, "time")
    assert "its audit was ended at 5" in failure.message
    assert "(--max-model-seconds); raise the limit, or leave it out" in failure.message
    assert len(sink.tables) == 3


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_model_that_takes_too_much_memory_is_ended_and_the_others_are_not(refs, jobs):
    sink = Memory()
    limits = Limits(memory_bytes=700_000_000)
    (failure,) = audit_many(refs, AuditConfig(), jobs=jobs, sink=sink, audit=audit_stubs.fill_memory, limits=limits)
    assert (failure.location, failure.kind) == (refs[1].model_path, "memory")
    assert "GB of memory (--max-model-memory)" in failure.message
    assert len(sink.tables) == 3


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("limits", [Limits(seconds=5.0), Limits(memory_bytes=10**9), Limits(input_bytes=10**9)])
def test_a_model_with_limits_on_memory_or_time_is_watched_from_another_process(refs, monkeypatch, jobs, limits):
    started = []

    def in_processes(plan, _jobs, _audit):
        started.extend(task.ref for task in plan)
        return iter(())

    monkeypatch.setattr("sfm_audit.audit.schedule.runner.in_processes", in_processes)
    sink = Memory()
    audit_many(refs[:1], AuditConfig(), jobs=jobs, sink=sink, limits=limits)
    needed = limits.seconds is not None or limits.memory_bytes is not None
    assert (len(started), len(sink.tables)) == ((1, 0) if needed else (0, 1))


def test_a_model_whose_files_are_larger_than_allowed_is_not_audited(refs):
    size, *others = (ref.num_bytes for ref in refs)
    limits = Limits(input_bytes=max(size, *others))
    assert audit_many(refs, AuditConfig(), jobs=1, sink=Memory(), limits=limits) == []
    larger = replace(refs[1], num_bytes=limits.input_bytes + 1)
    audited = []
    audit = lambda task: audited.append(task.ref) or audit_one(task)  # noqa: E731
    sink = Memory()
    given = [refs[0], larger, *refs[2:]]
    (failure,) = audit_many(given, AuditConfig(), jobs=1, sink=sink, audit=audit, limits=limits)
    assert (failure.location, failure.kind) == (refs[1].model_path, "too_large")
    assert audited == [refs[0], *refs[2:]]
    assert sink.dropped == [larger.key]


def test_a_model_whose_files_cannot_be_looked_at_is_asked_again(refs, monkeypatch):
    def stamp(location):
        raise LoadError(location, None, "a location", "none", "")

    sink = Memory()
    run(refs[:1], sink)
    monkeypatch.setattr("sfm_audit.audit.schedule.runner.input_stamp", stamp)
    asked = []
    audit = lambda task: asked.append(task.known_digest) or audit_one(task)  # noqa: E731
    run([replace(refs[0], stamp="")], sink, audit=audit)
    assert asked == [sink.states[refs[0].key].digest]


def test_verify_reads_what_sizes_and_times_hide(refs):
    sink = Memory()
    run(refs, sink)
    before = dict(sink.tables)
    file = Path(refs[0].location, "points3D.bin")
    stat = file.stat()
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    run(refs, sink)
    assert all(sink.tables[key] is tables for key, tables in before.items())
    audit_many(refs, AuditConfig(), jobs=1, sink=sink, verify=True)
    assert [key for key, tables in before.items() if sink.tables[key] is not tables] == [refs[0].key]


def test_touched_files_are_compared_by_content(refs):
    sink = Memory()
    run(refs, sink)
    before = dict(sink.tables)
    file = Path(refs[0].location, "images.bin")
    file.touch()
    assert input_stamp(refs[0].location) != sink.states[refs[0].key].stamp
    run(refs, sink)
    assert all(sink.tables[key] is tables for key, tables in before.items())
    content = bytearray(file.read_bytes())
    content[20] ^= 1
    file.write_bytes(content)
    run(refs, sink)
    assert sink.tables[refs[0].key] is not before[refs[0].key]
    assert sink.tables[refs[1].key] is before[refs[1].key]


def test_blas_has_one_thread_while_models_are_audited(refs):
    seen = []

    def look(task):
        seen.extend(pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas")
        return audit_one(task)

    run(refs, Memory(), audit=look)
    assert seen
    assert set(seen) == {1}


def test_the_state_of_a_model_covers_all_its_files(tmp_path):
    write_models(tmp_path, ["a"])
    folder = tmp_path / "a" / "sparse" / "0"
    states = [read_input_state(str(folder))]
    assert states[0].num_bytes == sum(path.stat().st_size for path in folder.iterdir())
    for name in ("rigs.bin", "points3D.bin", "cameras.txt"):
        (folder / name).write_bytes(b"changed")
        states.append(read_input_state(str(folder)))
    assert len({state.digest for state in states}) == len({state.stamp for state in states}) == 4


def test_files_are_hashed_while_they_are_read_where_two_threads_may_work(refs, monkeypatch):
    location = refs[0].location
    expected = read_input_state(location)
    names = []
    for name in ("read_input_state", "open_model"):
        real = getattr(task_module, name)
        said = lambda where, name=name, real=real: names.append((name, threading.get_ident())) or real(where)  # noqa: E731
        monkeypatch.setattr(task_module, name, said)
    with threads(2):
        state, model = task_module._read(location, None)
        assert (state, model.location) == (expected, location)
        assert len({thread for _, thread in names}) == 2
        names.clear()
        assert task_module._read(location, expected.digest) == (expected, None)
        assert [name for name, _ in names] == ["read_input_state"]


def test_files_that_change_while_they_are_hashed_and_read_are_read_again(refs, monkeypatch):
    location, read, states = refs[0].location, task_module.read_input_state, []

    def changing(where: str) -> InputState:
        states.append(read(where))
        if len(states) == 1:
            path = Path(where) / "points3D.bin"
            os.utime(path, ns=(0, 0))
        return states[-1]

    monkeypatch.setattr(task_module, "read_input_state", changing)
    with threads(2):
        state, _ = task_module._read(location, None)
    assert len(states) == 2
    assert state == states[1] != states[0]
    assert state.stamp == input_stamp(location)
