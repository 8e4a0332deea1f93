"""How are models audited on a Dask cluster? One task per model; the tables come back and are written here.

Dask decides where a model is audited and starts it again where a worker is lost; what is computed does not depend on
it. Only so many models are asked for at a time as keep the workers busy, so that finished tables do not pile up.
"""

from __future__ import annotations

import importlib.metadata
import logging
import multiprocessing
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed
from threadpoolctl import threadpool_limits

from sfm_audit.audit.schedule.errors import ClusterError
from sfm_audit.audit.schedule.guard import guarded
from sfm_audit.audit.schedule.lanes import Died, Lanes
from sfm_audit.audit.schedule.processes import in_one_process
from sfm_audit.audit.schedule.task import AuditFunction, Outcome, Task, died_twice

LOCAL: Final = "local"
_LOOPBACK: Final = "127.0.0.1"
_CONNECT_SECONDS: Final = 30
_FIRST_WORKER_SECONDS: Final = 300
_LOCAL_WORKERS_SECONDS: Final = 60
_LEAVING_SECONDS: Final = 30
_AHEAD: Final = 2  # models asked for per thread of the workers
_LOST: Final = "the cluster was lost; what was finished stays, the same command goes on"


def in_cluster(tasks: Sequence[Task], address: str, jobs: int, audit: AuditFunction) -> Generator[tuple[Task, Outcome]]:
    """Yield outcomes as they come from the workers of the scheduler at ``address``.

    A model whose worker was lost more often than the cluster allows is tried once more, alone, when all others are
    finished.

    Parameters
    ----------
    address : such as tcp://host:8786, or ``local``: ``jobs`` workers of one thread each on this machine, loopback only

    Raises
    ------
    ClusterError
        No scheduler or no worker answers, a worker has another version of sfm-audit, or the cluster was lost.
    """
    version = importlib.metadata.version("sfm-audit")
    with _client(address, jobs) as client:
        again: list[Task] = []
        for task, outcome in _run(client, tasks, audit, version):
            if outcome is None:
                again.append(task)
            else:
                yield task, outcome
        for task in again:
            for _, outcome in _run(client, [task], audit, version):
                yield task, outcome or died_twice(task, "its Dask worker was lost")


def _run(
    client: Client, tasks: Sequence[Task], audit: AuditFunction, version: str
) -> Iterator[tuple[Task, Outcome | None]]:
    """Yield outcomes; None for a model whose workers were lost."""
    waiting = iter(tasks)
    task_of: dict[Any, Task] = {}
    ended = as_completed(loop=client.loop, with_results=True, raise_errors=False)

    def ask() -> None:
        while len(task_of) < _AHEAD * max(1, sum(client.nthreads().values())):
            task = next(waiting, None)
            if task is None:
                return
            future = client.submit(_audit_there, audit, task, version, pure=False)
            task_of[future.key] = task
            ended.add(future)

    try:
        ask()
        while task_of:
            future, result = next(ended)
            task = task_of.pop(future.key)
            ask()
            yield task, _outcome(result, is_connected=client.status == "running")
    except (OSError, TimeoutError) as error:
        raise ClusterError(_LOST) from error


def _outcome(result: Any, *, is_connected: bool) -> Outcome | None:
    """Return what a future gave; None where its worker was lost.

    Not by its status: when a worker is lost, a future whose result is already here is "lost" as well.
    """
    if isinstance(result, Outcome):
        return result
    if isinstance(result, tuple):
        _, error, trace = result
        if isinstance(error, KilledWorker):
            return None
        raise error.with_traceback(trace)
    if is_connected:  # cancelled, but not by the loss of the scheduler
        return None
    raise ClusterError(_LOST)


def _audit_there(audit: AuditFunction, task: Task, version: str) -> Outcome:
    """Run on a worker."""
    own = importlib.metadata.version("sfm-audit")
    if own != version:
        advice = "install the same version on all machines"
        raise ClusterError(f"a Dask worker has sfm-audit {own}, this machine {version}; {advice}")
    threadpool_limits(limits=1)
    if not task.limits.need_a_process:
        return guarded(audit, task)
    multiprocessing.current_process().daemon = False  # workers are, and those may start no processes
    with Lanes[Task]() as lanes:
        answer = in_one_process(lanes, audit, task)
    return died_twice(task, str(answer)) if isinstance(answer, Died) else answer


@contextmanager
def _client(address: str, jobs: int) -> Iterator[Client]:
    for name in ("distributed", "distributed.client"):  # a lost cluster is one line, and it is ours
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if address == LOCAL:
        settings = {
            "distributed.scheduler.allowed-failures": 0,  # a model that kills its worker is tried once more by us
            "distributed.scheduler.http.routes": [],
            "distributed.worker.http.routes": [],
        }
        with (
            dask.config.set(settings),
            _left_in_time(_local_cluster()) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            cluster.scale(jobs)
            try:  # with n_workers=jobs the constructor would wait for ever for a worker that died while it started
                client.wait_for_workers(jobs, timeout=_LOCAL_WORKERS_SECONDS)
            except TimeoutError as error:
                reason = f"not all in {_LOCAL_WORKERS_SECONDS} s"
                raise ClusterError(f"--dask local: the workers did not start ({reason}); run it again") from error
            yield client
        return
    try:
        client = Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(f"--dask {address}: no Dask scheduler answers ({error}); start one, or use local") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_FIRST_WORKER_SECONDS)
        except TimeoutError as error:
            advice = f"start some: dask worker {address}"
            raise ClusterError(f"--dask {address}: no worker in {_FIRST_WORKER_SECONDS} s; {advice}") from error
        yield client


@contextmanager
def _left_in_time(cluster: LocalCluster) -> Iterator[LocalCluster]:
    """Close a cluster at the end, and do not wait for ever where a worker was killed while it did (seen with 2024.8).

    What is left of it ends with this process.
    """
    try:
        yield cluster
    finally:
        with suppress(TimeoutError):
            cluster.close(timeout=_LEAVING_SECONDS)


def _local_cluster() -> LocalCluster:
    """Return a cluster on the loopback that has no workers yet."""
    try:
        return LocalCluster(
            n_workers=0,
            processes=True,
            threads_per_worker=1,
            host=_LOOPBACK,
            dashboard_address=f"{_LOOPBACK}:0",
            worker_dashboard_address=f"{_LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:  # no port, no thread
        reason = " ".join(str(error).split())
        raise ClusterError(f"--dask local: the workers did not start ({reason}); run it again") from error
