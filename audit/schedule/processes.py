"""How are models audited in processes of this machine? Large ones over several, small ones whole, largest first."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Final

from sfm_audit.audit.schedule.guard import exceeded, guarded
from sfm_audit.audit.schedule.lanes import Died, Exceeded, Lanes, ProcessDiedError
from sfm_audit.audit.schedule.task import AuditFunction, Outcome, Task, died_twice

BYTES_WORTH_A_PROCESS: Final = 50_000_000  # of input: two seconds of work; a process costs one
# Spreading one model costs more: what its images share is written and mapped, and what is spread is a small part of an
# audit, whose threads are there anyway. 229 MB take 15.2 s whole, 19.6 s in two; more was not measured.
BYTES_WORTH_A_SHARE: Final = 1_000_000_000


def in_processes(plan: Sequence[Task], jobs: int, audit: AuditFunction) -> Generator[tuple[Task, Outcome]]:
    """Yield outcomes as they come, from at most ``jobs`` processes at work; ``plan`` as `planned` makes it.

    A model whose process dies is tried once more, in one process, when all others are finished; the other models do not
    notice.
    """
    waiting = deque(plan)
    again: list[Task] = []
    ended: list[tuple[Task, Outcome]] = []
    num_at_work = 0
    with Lanes[Task]() as lanes:
        while waiting or lanes.num_busy:
            while waiting and num_at_work + _num_at_work(waiting[0]) <= jobs:
                task = waiting.popleft()
                num_at_work += _num_at_work(task)
                _start(lanes, audit, task)
            yield from ended  # what the caller does with them is done while the processes work on
            ended = []
            for task, answer in lanes.wait():
                num_at_work -= _num_at_work(task)
                if isinstance(answer, Died):
                    again.append(replace(task, num_processes=1, num_threads=1))
                elif isinstance(answer, Exceeded):
                    ended.append((task, exceeded(task, answer)))
                else:
                    ended.append((task, answer))
        yield from ended
        for task in again:
            yield task, _last_try(lanes, audit, task)


def in_one_process(lanes: Lanes[Task], audit: AuditFunction, task: Task) -> Outcome | Died:
    """Audit one model in another process within its limits, and wait for it."""
    _start(lanes, audit, task)
    ((_, answer),) = lanes.wait()
    return exceeded(task, answer) if isinstance(answer, Exceeded) else answer


def _last_try(lanes: Lanes[Task], audit: AuditFunction, task: Task) -> Outcome:
    answer = in_one_process(lanes, audit, task)
    return died_twice(task, str(answer)) if isinstance(answer, Died) else answer


def _start(lanes: Lanes[Task], audit: AuditFunction, task: Task) -> None:
    lanes.start_limited(task, (task.limits.memory_bytes, task.limits.seconds), _call, audit, task)


def planned(tasks: Sequence[Task], jobs: int) -> list[Task]:
    """Return the tasks, largest input first, each with its share of the processes and threads, at least one.

    A model gets several where it is more than one process's share of the whole work, and large enough that starting
    them pays: otherwise whole models side by side keep all processes busy and share nothing. Threads cost nothing to
    start.
    """
    total = max(1, sum(task.ref.num_bytes for task in tasks))

    def with_share(task: Task) -> Task:
        num_threads = max(1, jobs * task.ref.num_bytes // total)
        num_processes = max(1, min(num_threads, task.ref.num_bytes // BYTES_WORTH_A_SHARE))
        if task.limits.memory_bytes is not None:  # a limit holds for one process, not for several that share pages
            num_processes = 1
        return replace(task, num_processes=num_processes, num_threads=num_threads)

    return [with_share(task) for task in sorted(tasks, key=lambda task: -task.ref.num_bytes)]


def _num_at_work(task: Task) -> int:
    """Return how many processors a task takes: its threads and its processes work in turns."""
    return max(task.num_threads, task.num_processes)


def _call(audit: AuditFunction, task: Task) -> Outcome | Died:
    try:
        return guarded(audit, task)
    except ProcessDiedError:  # one of those over which the images were spread
        return Died(None)
