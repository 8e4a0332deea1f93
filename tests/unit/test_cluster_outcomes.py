"""What a Dask future that ended says of its model."""

import asyncio
import time
from asyncio import CancelledError

import pytest

pytest.importorskip("distributed")

from distributed import KilledWorker
from run_samples import make_ref

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.schedule import cluster
from sfm_audit.audit.schedule.cluster import _audit_there, _outcome
from sfm_audit.audit.schedule.errors import ClusterError
from sfm_audit.audit.schedule.task import Failure, Task, Unchanged


@pytest.mark.parametrize("is_connected", [True, False])
@pytest.mark.parametrize("outcome", [Unchanged(), Failure("a/0", "cut short")])
def test_a_result_that_is_here_counts_whatever_became_of_its_worker(outcome, is_connected):
    assert _outcome(outcome, is_connected=is_connected) is outcome


def test_a_model_that_killed_its_workers_is_tried_again():
    assert _outcome((KilledWorker, KilledWorker.__new__(KilledWorker), None), is_connected=True) is None


def test_a_cancelled_model_is_tried_again_while_there_is_a_cluster():
    assert _outcome(CancelledError("key"), is_connected=True) is None
    with pytest.raises(ClusterError, match="the cluster was lost"):
        _outcome(CancelledError("key"), is_connected=False)


def test_an_error_of_ours_keeps_its_kind():
    with pytest.raises(ZeroDivisionError):
        _outcome((ZeroDivisionError, ZeroDivisionError("x"), None), is_connected=True)


def test_a_worker_of_another_version_audits_nothing():
    asked = []
    with pytest.raises(ClusterError, match=r"a Dask worker has sfm-audit .*, this machine 0\.0\.0; install the same"):
        _audit_there(asked.append, Task(make_ref(), AuditConfig(), None), "0.0.0")
    assert asked == []


def test_a_cluster_that_does_not_end_holds_nobody(monkeypatch):
    """As where a worker was killed while its nanny closed it: what closes the cluster waits for ever."""

    async def never(_):
        await asyncio.sleep(3600)

    found = cluster._local_cluster()
    with monkeypatch.context() as patch:
        patch.setattr(type(found), "_close", never)
        patch.setattr(cluster, "_LEAVING_SECONDS", 0.2)
        start = time.monotonic()
        with cluster._left_in_time(found) as inside:
            assert inside is found
        assert time.monotonic() - start < 30
    assert found.status.name == "running"
    with cluster._left_in_time(found):
        pass
    assert found.status.name == "closed"


def test_what_was_raised_inside_a_cluster_is_raised():
    class Lost:
        closed = False

        def close(self, timeout):
            self.closed = timeout == cluster._LEAVING_SECONDS
            raise TimeoutError(f"timed out after {timeout} s.")

    lost = Lost()
    with pytest.raises(ClusterError, match="lost"), cluster._left_in_time(lost):
        raise ClusterError("lost")
    assert lost.closed
