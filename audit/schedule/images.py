"""How are the images of one large model spread over processes? They all read one copy of what the images share.

What a model's images share (residuals, tracks, the joint system) is computed once, by the process that audits the
model, pickled into a file without a name, and mapped into the memory of the others: the numbers they work on are the
same bytes in the same layout, so the tables are the same to the last bit.
"""

from __future__ import annotations

import itertools
import math
import mmap
import os
import pickle
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Final, TypeVar

import numpy as np

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.spreading import Spread, in_turn
from sfm_audit.audit.kernels import path_taken
from sfm_audit.audit.schedule.lanes import Died, Lanes, ProcessDiedError

_ALIGNMENT: Final = 64
_SMALL_BYTES: Final = 4096  # arrays below that are pickled with their owners
_PARTS_PER_PROCESS: Final = 8  # so that a process with slow images does not keep the others waiting
_HEADER: Final = struct.Struct("<QQ")  # bytes of pickle, number of arrays
_LENGTH: Final = struct.Struct("<Q")
_OPEN_FILES: Final = Path("/proc/self/fd")

T = TypeVar("T")
_serial = itertools.count()


@contextmanager
def image_processes(num_processes: int, paths: set[str] | None = None) -> Iterator[Spread[ModelAuditor]]:
    """Yield a way to run a function over the images of a model: in turn, or in that many processes.

    paths: a set to which those processes add the path that their numbers take, compiled kernels or numpy.
    """
    seen = set() if paths is None else paths
    if num_processes <= 1 or not _OPEN_FILES.exists():
        yield in_turn
        return
    with Lanes[int]() as lanes:
        lanes.warm_up(num_processes)

        def spread(function: Callable[[ModelAuditor, range], list[T]], auditor: ModelAuditor) -> list[T]:
            with tempfile.TemporaryFile() as file:
                try:
                    write_shared(auditor, file)
                except OSError:  # no room for it: this process has all it needs
                    return in_turn(function, auditor)
                place = f"/proc/{os.getpid()}/fd/{file.fileno()}", next(_serial)
                return _gather(lanes, num_processes, len(auditor.model.images), (place, function), seen)

        yield spread


def _gather(
    lanes: Lanes[int], num_processes: int, num_images: int, call: tuple[Any, ...], paths: set[str]
) -> list[Any]:
    """Answers of all images in their order; raises ProcessDiedError when a process dies."""
    size = max(1, math.ceil(num_images / (num_processes * _PARTS_PER_PROCESS)))
    answers: dict[int, list[Any]] = {}
    waiting = iter(range(0, num_images, size))
    while len(answers) * size < num_images:
        for start in itertools.islice(waiting, num_processes - lanes.num_busy):
            lanes.start(start, _run_part, *call, start, min(start + size, num_images))
        for start, answer in lanes.wait():
            if isinstance(answer, Died):
                raise ProcessDiedError(str(answer))
            path, answers[start] = answer
            paths.add(path)
    return [item for start in sorted(answers) for item in answers[start]]


def _run_part(
    place: tuple[str, int], function: Callable[[Any, range], list[T]], start: int, stop: int
) -> tuple[str, list[T]]:
    with np.errstate(all="ignore"):  # as `audit_model` does
        return str(path_taken()), function(_opened(*place), range(start, stop))


@lru_cache(maxsize=1)
def _opened(path: str, serial: int) -> Any:
    del serial  # a file may get the number of one that was closed
    with Path(path).open("rb") as file:
        return read_shared(file)


def write_shared(value: Any, file: IO[bytes]) -> None:
    """Pickle a value with its large arrays side by side, each at a multiple of 64 bytes."""
    arrays: list[pickle.PickleBuffer] = []

    def keep(array: pickle.PickleBuffer) -> bool:
        is_small = array.raw().nbytes < _SMALL_BYTES
        if not is_small:
            arrays.append(array)
        return is_small

    data = pickle.dumps(value, protocol=5, buffer_callback=keep)
    file.write(_HEADER.pack(len(data), len(arrays)))
    file.write(b"".join(_LENGTH.pack(array.raw().nbytes) for array in arrays))
    file.write(data)
    for array in arrays:
        file.write(bytes(-file.tell() % _ALIGNMENT))
        file.write(array.raw())
    file.flush()


def read_shared(file: IO[bytes]) -> Any:
    """Return the value that `write_shared` wrote; its large arrays are views of the file and cannot be written."""
    memory = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    num_pickled, num_arrays = _HEADER.unpack_from(memory, 0)
    start = _HEADER.size + num_arrays * _LENGTH.size
    lengths = [_LENGTH.unpack_from(memory, _HEADER.size + i * _LENGTH.size)[0] for i in range(num_arrays)]
    arrays = []
    end = start + num_pickled
    for length in lengths:
        first = end + -end % _ALIGNMENT
        end = first + length
        arrays.append(memory[first:end])
    return pickle.loads(memory[start : start + num_pickled], buffers=arrays)  # noqa: S301 - our own parent wrote it
