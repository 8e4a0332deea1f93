"""Where models are audited must not be seen in the tables: processes, shares of them, and the images of one model."""

import io
import os
import pickle
import signal
import tempfile
import threading
from dataclasses import replace
from functools import partial

import audit_stubs
import numpy as np
import pyarrow.parquet as pq
import pytest
import threadpoolctl
from corpus import UNREADABLE, corpus_models
from run_samples import make_ref, wait_for

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine import spreading
from sfm_audit.audit.engine.model import ModelAuditor, audit_model
from sfm_audit.audit.joint import design, misfit, normal
from sfm_audit.audit.kernels import consistency, projection
from sfm_audit.audit.kernels.threads import over_ranges, ranges, threads
from sfm_audit.audit.schedule.images import image_processes, read_shared, write_shared
from sfm_audit.audit.schedule.lanes import Died, Lanes, RemoteTracebackError
from sfm_audit.audit.schedule.processes import BYTES_WORTH_A_SHARE, in_processes, planned
from sfm_audit.audit.schedule.task import Audited, Limits, Task, audit_one
from sfm_audit.audit.simulate.dataset import DatasetSpec, scene_folder, write_dataset
from sfm_audit.loaders import discover, open_model

GB = 8 * BYTES_WORTH_A_SHARE
CONFIG = AuditConfig()


def tasks_of(sizes):
    return [Task(replace(make_ref(f"data/{i}"), num_bytes=size), CONFIG, None) for i, size in enumerate(sizes)]


@pytest.mark.parametrize(
    ("sizes", "jobs", "shares"),
    [
        ((GB,), 4, [4]),  # alone: all processes
        ((GB, GB), 4, [2, 2]),
        ((GB,) * 4, 4, [1, 1, 1, 1]),
        ((GB,) * 5, 4, [1, 1, 1, 1, 1]),
        ((GB, 8 * GB, GB), 5, [4, 1, 1]),  # the largest first
        ((1000,), 4, [1]),  # not worth a process
        ((2 * BYTES_WORTH_A_SHARE,), 16, [2]),
        ((0, 0), 2, [1, 1]),
    ],
)
def test_a_model_gets_its_share_of_the_processes(sizes, jobs, shares):
    plan = planned(tasks_of(sizes), jobs)
    assert [task.num_processes for task in plan] == shares
    assert [task.ref.num_bytes for task in plan] == sorted(sizes, reverse=True)
    total = max(1, sum(sizes))
    assert [task.num_threads for task in plan] == [max(1, jobs * task.ref.num_bytes // total) for task in plan]
    assert sum(share for share in shares if share > 1) <= jobs


def test_a_limit_on_memory_holds_for_one_process():
    limited = [replace(task, limits=Limits(memory_bytes=1)) for task in tasks_of((GB,))]
    ((one,), (two,)) = planned(limited, 4), planned([replace(limited[0], limits=Limits(seconds=1.0))], 4)
    assert (one.num_processes, one.num_threads) == (1, 4)
    assert (two.num_processes, two.num_threads) == (4, 4)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Thirty images, some of them wrong, so that somebody is excluded."""
    root = tmp_path_factory.mktemp("scene")
    write_dataset(root, DatasetSpec(1, 30, linked=(250, 250), keypoints=300, defects=0.1), 1)
    return scene_folder(root, 0)


def audited(location, spread=None, **config):
    options = {"spread": spread} if spread else {}
    return audit_model(open_model(location), AuditConfig(**config), observations=True, **options).tables


@pytest.fixture(scope="module")
def spread():
    """Three processes for all models."""
    with image_processes(3) as start:
        yield start


def check_spread_changes_nothing(location, spread, **config):
    alone, together = audited(location, **config), audited(location, spread, **config)
    assert alone.keys() == together.keys()
    for name, table in alone.items():
        assert table.equals(together[name]), name


@pytest.mark.parametrize("number", [2, 5])
def test_threads_change_nothing(scene, number, monkeypatch):
    """Of many ranges, of a few images each; the scene is too small for more than one."""
    alone = audited(scene)
    began = []

    def in_small_ranges(function, num_images, weights=None, range_weight=1000.0):
        is_one = len(ranges(num_images, weights, min(range_weight, 1000.0))) == 1  # needs no other thread

        def noted(start, stop):
            began.append("sfm-audit, one" if is_one else threading.current_thread().name)
            return function(start, stop)

        return over_ranges(noted, num_images, weights, min(range_weight, 1000.0))

    for module in (spreading, misfit, normal, design, consistency, projection):
        monkeypatch.setattr(module, "over_ranges", in_small_ranges)
    with threads(number):
        together = audited(scene)
    assert len(began) > 30
    assert all(name.startswith("sfm-audit") for name in began)
    for name, table in alone.items():
        assert table.equals(together[name]), name


@pytest.mark.parametrize("noise", ["track", "constant"])
def test_images_spread_over_processes_give_the_same_bits(scene, spread, noise):
    check_spread_changes_nothing(scene, spread, noise=noise)


@pytest.mark.corpus
def test_models_of_the_corpus_spread_over_processes_give_the_same_bits(corpus, spread):
    """SFM_AUDIT_SPREAD=1: every model of the corpus, not one."""
    chosen = corpus_models() if "SFM_AUDIT_SPREAD" in os.environ else [corpus / "models/own_south_building_sub_radial"]
    for location in chosen:
        if location.name not in UNREADABLE:
            check_spread_changes_nothing(location, spread)


def test_a_large_model_is_spread_by_the_runner_and_gives_the_same_bits(scene):
    (ref,) = discover([scene]).refs
    task = Task(replace(ref, num_bytes=GB), CONFIG, None)
    (plan,) = planned([task], 2)
    assert (plan.num_processes, plan.num_threads) == (2, 2)
    ((_, outcome),) = in_processes([plan], 2, audit_one)
    expected = audit_one(task)
    assert isinstance(outcome, Audited)
    assert all(outcome.tables[name].equals(table) for name, table in expected.tables.items())


def test_tables_that_come_from_another_process_are_written_to_the_same_bytes(scene):
    (ref,) = discover([scene]).refs
    here = audit_one(Task(ref, CONFIG, None, observations=True))
    assert isinstance(here, Audited)
    there = pickle.loads(pickle.dumps(here))  # noqa: S301 - our own
    assert (there.state, there.seconds, there.computed_by) == (here.state, here.seconds, here.computed_by)
    assert list(there.tables) == list(here.tables)
    for name, table in here.tables.items():
        assert there.tables[name].schema.equals(table.schema, check_metadata=True)
        assert as_parquet(there.tables[name]) == as_parquet(table), name


def as_parquet(table):
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def test_a_model_one_of_whose_image_processes_dies_is_audited_again_in_one(scene, tmp_path):
    (ref,) = discover([scene]).refs
    task = Task(replace(ref, scene="deadly"), CONFIG, None, num_processes=2)
    mark = tmp_path / "died"
    ((_, outcome),) = in_processes([task], 2, partial(audit_stubs.lose_an_image_process, mark=mark))
    assert mark.exists()
    assert isinstance(outcome, Audited)


def test_without_room_for_the_shared_file_the_images_are_audited_in_turn(scene, spread, monkeypatch):
    def full(*_: object):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sfm_audit.audit.schedule.images.write_shared", full)
    assert audited(scene, spread)["images"].equals(audited(scene)["images"])


def test_an_auditor_travels_without_its_processes(scene):
    auditor = ModelAuditor(open_model(scene), spread=lambda *_: pytest.fail("not here"))
    with tempfile.TemporaryFile() as file:
        write_shared(auditor, file)
        copy = read_shared(file)
    assert np.array_equal(copy.model.points.xyz_world, auditor.model.points.xyz_world)
    assert not copy.model.points.xyz_world.flags.writeable
    assert copy.image(0).verdict == ModelAuditor(open_model(scene)).image(0).verdict


def test_a_call_runs_elsewhere_with_one_blas_thread_and_its_error_comes_back():
    with Lanes() as lanes:
        lanes.start("threads", threadpoolctl.threadpool_info)
        ((key, pools),) = lanes.wait()
        assert key == "threads"
        assert {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"} <= {1}
        lanes.start("pid", os.getpid)
        ((_, pid),) = lanes.wait()
        assert pid != os.getpid()
        lanes.start("error", int, "x")
        with pytest.raises(ValueError, match="invalid literal") as caught:
            lanes.wait()
        assert isinstance(caught.value.__cause__, RemoteTracebackError)
        assert "Traceback" in str(caught.value.__cause__)


def test_the_death_of_a_process_costs_its_own_call_alone():
    with Lanes() as lanes:
        lanes.start("victim", signal.pause)
        lanes.start("other", os.getpid)
        ((key, other),) = lanes.wait()
        assert key == "other"
        (victim,) = [lane.process.pid for lane, _ in lanes._busy.values()]
        os.kill(victim, signal.SIGKILL)
        ((key, answer),) = lanes.wait()
        assert (key, answer, str(answer)) == ("victim", Died(-9), "killed by SIGKILL")
        os.kill(other, signal.SIGKILL)  # while it is idle
        wait_for(lambda: not lanes._idle[0].process.is_alive())
        lanes.start("again", os.getpid)
        ((_, again),) = lanes.wait()
        assert again not in {other, victim}


def test_an_answer_that_is_half_written_is_a_death_and_not_a_wait():
    with Lanes() as lanes:
        lanes.start("half", audit_stubs.send_half_an_answer)
        assert lanes.wait() == [("half", Died(-9))]


def test_an_error_in_the_caller_ends_the_processes_at_once():
    with pytest.raises(ZeroDivisionError), Lanes() as lanes:  # noqa: PT012
        lanes.start("long", signal.pause)
        (process,) = [lane.process for lane, _ in lanes._busy.values()]
        raise ZeroDivisionError
    assert not process.is_alive()


def test_a_process_whose_memory_is_watched_gives_it_back_whatever_there_is():
    """One process, asked three times: what it says is what happened after the calls before."""
    with Lanes[int]() as lanes:
        answers = []
        for key, max_bytes in enumerate((None, 1 << 40, None)):
            lanes.start_limited(key, (max_bytes, None), audit_stubs.given_back)
            answers += lanes.wait()
    asked = [{"is_limited": False}, {"is_limited": True}]
    assert answers == [(0, []), (1, asked[:1]), (2, asked)]
