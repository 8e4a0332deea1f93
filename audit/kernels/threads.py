"""Who runs a kernel over ranges of images at the same time? Threads of Python, whose lock a kernel does not hold."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import Context, ContextVar, copy_context
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

RANGE_WEIGHT: Final = 100_000.0
"""Observations of a range where nothing else is said: milliseconds of work, where a thread costs 0.1."""

T = TypeVar("T")
_num_threads: ContextVar[int] = ContextVar("num_threads", default=1)


def num_threads() -> int:
    """Return how many threads may work at the same time for whoever asks; 1 where nobody has said more."""
    return _num_threads.get()


@contextmanager
def threads(number: int) -> Iterator[None]:
    """Let that many threads work inside; results do not depend on it."""
    before = _num_threads.set(max(1, number))
    try:
        yield
    finally:
        _num_threads.reset(before)


def ranges(
    num_images: int, weights: npt.NDArray[np.number] | None = None, range_weight: float = RANGE_WEIGHT
) -> list[range]:
    """Return consecutive ranges of images of about equal weight; they do not depend on the number of threads.

    Parameters
    ----------
    num_images : how many there are
    weights : (num_images,) work of each, such as its number of observations; 1 each when None
    range_weight : ranges end at its multiples; an image is never divided
    """
    if num_images <= 0:
        return []
    if weights is None:
        size = max(1, int(range_weight))
        return [range(start, min(start + size, num_images)) for start in range(0, num_images, size)]
    if len(weights) != num_images:
        raise ValueError(f"expected {num_images} weights, found {len(weights)}")
    ends = np.cumsum(weights, dtype=np.float64)
    if not math.isfinite(ends[-1]) or np.any(np.asarray(weights) < 0):
        raise ValueError("weights must be finite and not negative")
    # Images whose weights end within the same multiple of range_weight stay together.
    part = np.maximum(np.ceil(ends / range_weight), 1.0)
    starts = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), num_images]
    return [range(start, stop) for start, stop in itertools.pairwise(starts)]


def over_ranges(
    function: Callable[[int, int], T],
    num_images: int,
    weights: npt.NDArray[np.number] | None = None,
    range_weight: float = RANGE_WEIGHT,
) -> list[T]:
    """Return function(start, stop) of consecutive ranges of images, in their order.

    The ranges are those of `ranges`, for any number of threads, so that results are the same to the last bit. The
    function writes into rows of its own range only. ``np.errstate`` and other context of the caller hold in threads. An
    error is raised when all ranges that began have ended: that of the first range that has one.
    """
    parts = ranges(num_images, weights, range_weight)
    number = min(num_threads(), len(parts))
    if number <= 1:
        return [function(part.start, part.stop) for part in parts]
    return _in_threads(function, parts, number)


def together(first: Callable[[], object], second: Callable[[], object]) -> None:
    """Call both, at the same time where two threads may work; neither may need what the other computes.

    Each of them may have as many threads as the caller: while one has Python's lock, kernels of the other go on.

    Whoever interrupts the first does not wait for the second: its thread ends with the process.
    """
    if num_threads() <= 1:
        first()
        second()
        return
    errors: list[BaseException] = []

    def keeping_errors() -> None:
        try:
            second()
        except BaseException as error:  # noqa: BLE001 - raised again below
            errors.append(error)

    thread = threading.Thread(target=copy_context().run, args=(keeping_errors,), name="sfm-audit", daemon=True)
    thread.start()
    try:
        first()
    except Exception:
        thread.join()
        raise
    thread.join()
    if errors:
        raise errors[0]


def _in_threads(function: Callable[[int, int], T], parts: Sequence[range], number: int) -> list[T]:
    """Threads live for one call only: a process that forks or ends has none that it did not ask for."""
    with ThreadPoolExecutor(number, thread_name_prefix="sfm-audit") as pool:
        started = [pool.submit(_context_of_one().run, function, part.start, part.stop) for part in parts]
        try:
            return [one.result() for one in started]
        except BaseException:
            for one in started:
                one.cancel()
            raise


def _context_of_one() -> Context:
    """The caller's context, in which what a thread asks for runs in that thread alone."""
    context = copy_context()
    context.run(_num_threads.set, 1)
    return context
