"""How the validation study runs: seeded tasks on one or more processes, and rates held against their bounds."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pandas as pd
from scipy import stats
from threadpoolctl import threadpool_limits
from tqdm import tqdm

CHANCE = 0.001  # two-sided: a rate further from its bounds than this explains is a violation
HOLDS, WITHIN_CHANCE, VIOLATED = "holds", "within chance", "VIOLATED"


@dataclass(frozen=True, slots=True)
class Task:
    """A piece of the study that one process does: ``function(*args)`` gives rows for the table named ``part``.

    cost: rough seconds; the dearest tasks start first.
    """

    part: str
    function: Callable[..., pd.DataFrame]
    args: tuple[object, ...]
    cost: float = 1.0

    def __call__(self) -> pd.DataFrame:
        """Run."""
        return self.function(*self.args)


def run_tasks(tasks: Sequence[Task], jobs: int, keep: Path | None = None) -> dict[str, pd.DataFrame]:
    """Run all tasks and return the tables by part; the rows do not depend on ``jobs``, nor on who was first.

    With ``keep``, what is done is kept in that folder, and not done again by a later run of the same code.
    """
    progress = tqdm(total=sum(task.cost for task in tasks), disable=None, bar_format="{l_bar}{bar}| {elapsed}")
    done: dict[int, pd.DataFrame] = {}
    errors: list[Exception] = []
    order = sorted(range(len(tasks)), key=lambda row: -tasks[row].cost)
    with _pool(jobs) as pool:
        futures = {pool.submit(_run, tasks[row], keep): row for row in order}
        for future in as_completed(futures):
            error = future.exception()
            if isinstance(error, Exception):
                errors.append(error)
            else:
                done[futures[future]] = future.result()
            progress.update(tasks[futures[future]].cost)
    progress.close()
    if errors:
        raise ExceptionGroup(f"{len(errors)} of {len(tasks)} tasks failed", errors)
    frames: dict[str, list[pd.DataFrame]] = {}
    for row, task in enumerate(tasks):
        frames.setdefault(task.part, []).append(done[row])
    return {part: pd.concat(parts, ignore_index=True) for part, parts in frames.items()}


def _pool(jobs: int) -> Executor:
    """One process is this one."""
    if jobs == 1:
        return ThreadPoolExecutor(1, initializer=_one_thread)
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_one_thread)


def _run(task: Task, keep: Path | None) -> pd.DataFrame:
    """Run a task, or read what it gave before."""
    if keep is None:
        return task()
    name = f"{task.part} {task.function.__name__} {task.args!r}"
    path = keep / f"{task.part}-{hashlib.sha256(name.encode()).hexdigest()[:16]}.parquet"
    if not path.exists():
        keep.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        task().to_parquet(part, index=False)
        part.replace(path)
    return pd.read_parquet(path)


def _one_thread() -> None:
    """Matrices are small: a second BLAS thread only takes the core of the other process."""
    threadpool_limits(limits=1, user_api="blas")


@dataclass(frozen=True, slots=True)
class Check:
    """A share that must lie between two bounds. claim: what must hold; cell: where it was measured."""

    claim: str
    cell: str
    hits: int
    trials: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        """The share."""
        return self.hits / self.trials if self.trials else float("nan")

    @property
    def outcome(self) -> str:
        """`HOLDS`, `WITHIN_CHANCE` where a true share on the bound could have given this, or `VIOLATED`."""
        if not self.trials or self.low <= self.rate <= self.high:
            return HOLDS
        at_least = float(stats.binom.ppf(CHANCE / 2, self.trials, self.low))
        at_most = float(stats.binom.ppf(1 - CHANCE / 2, self.trials, self.high))
        return WITHIN_CHANCE if at_least <= self.hits <= at_most else VIOLATED


def check(claim: str, cell: str, hits: pd.Series, low: float = 0.0, high: float = 1.0) -> Check:
    """Check the share of True in ``hits``."""
    return Check(claim, cell, int(hits.sum()), len(hits), low, high)
