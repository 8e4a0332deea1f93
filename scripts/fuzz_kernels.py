"""Compiled kernels under the address and undefined-behaviour sanitizers (docs/kernels.md).

    scripts/fuzz_kernels.py [--quick] [--minutes N] [--seed S]

The sources are built once more, with -fsanitize=address,undefined,float-cast-overflow; a process that uses this library
1. audits models: every lens, cameras shared and not, images with no, one, few and many points (--quick: 40,000,
   otherwise a million), and damaged models of scripts/fuzz.py;
2. calls every kernel again with what it was called with in 1, where numbers are now NaN, infinite, huge, tiny or zero.
The first error of a sanitizer ends the process, and this script with exit code 1 and the name of the kernel. A kernel
that no audit calls is an error as well: it needs a case in CALLS. --quick takes the same inputs every time.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from scripts import build_kernels  # noqa: E402 - the folder that holds it is on the path only now

SANITIZE: Final = (
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-g",
    "-O1",
    "-DSFM_ONE_CLONE",
)
RUNTIME: Final = "libasan.so"
SOURCES_OF: Final = "audit/kernels/source"
NO_KERNEL: Final = frozenset({"sfm_audit_sources", "sfm_audit_runs_here"})


def call_pair_sums(rng: np.random.Generator) -> None:
    """Compare images of models that are too small for it."""
    from sfm_audit.audit.kernels import witnesses  # noqa: PLC0415 - in the child only

    for num_points, num_images in ((1, 1), (40, 7), (9, 30)):
        image, point = np.nonzero(rng.random((num_images, num_points)) < 0.5)
        sees, views = rng.random(len(point)) < 0.5, (rng.normal(size=(3, len(point))), rng.normal(size=len(point)))
        witnesses.pair_sums((num_points, num_images), point, image, sees, views)


def call_near_entries(rng: np.random.Generator) -> None:
    """Entries of a band; the models here are too small to have one."""
    from sfm_audit.audit.kernels.joint_parts import near_entries  # noqa: PLC0415 - in the child only

    for _ in range(20):
        size = int(rng.integers(1, 60))
        first = np.unique([0, *rng.integers(0, size, int(rng.integers(0, 12))), size]).astype(np.int64)
        rows, columns = np.diff(first), np.minimum(first[:-1] + rng.integers(1, 40), size) - first[:-1]
        columns = np.maximum(columns, rows)
        starts = np.concatenate([[0], np.cumsum(rows * columns)]).astype(np.int64)
        place = np.sort(rng.choice(size, int(rng.integers(0, size + 1)), replace=False)).astype(np.int64)
        near_entries(place, first, rng.normal(size=int(starts[-1])), starts, columns.astype(np.int64))


def call_dense_entries(rng: np.random.Generator) -> None:
    """Entries of a matrix: of images beside which another one has fields in the base."""
    from sfm_audit.audit.kernels.joint_parts import dense_entries  # noqa: PLC0415 - in the child only

    for size in (0, 1, 7, 40):
        chosen = rng.choice(size, size // 2, replace=False).astype(np.int64)
        dense_entries(rng.normal(size=(size, size)), chosen)


CALLS: Final[dict[str, Callable[[np.random.Generator], None]]] = {
    "joint_dense_entries": call_dense_entries,
    "joint_near_entries": call_near_entries,
    "witness_pair_sums": call_pair_sums,
}
"""By name: calls of a kernel's Python module with random arguments, for kernels that no audit here calls."""

SPECIALS: Final = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1.8e308, -1.8e308, 1e300, 5e-324, 1e-200, 1e17, -1.0, 1.0)
KEPT: Final = 12  # calls of each kernel that are kept from the audits
LIMIT_SECONDS: Final = 120.0  # of one call: a loop that NaN never ends
QUICK_ROUNDS: Final = 120
CHECK_LEAKS: Final = "__lsan_do_recoverable_leak_check"
_LEAK: Final = re.compile(r"^(?:Direct|Indirect) leak .*?(?:\n\n|\Z)", re.MULTILINE | re.DOTALL)


def symbols(folder: Path = build_kernels.SOURCES) -> set[str]:
    """Return the names of all kernels of the sources."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.c")))
    return set(re.findall(r"^\s*KERNEL\b[^;{(]*?(\w+)\s*\(", text, flags=re.MULTILINE)) - NO_KERNEL


class Recorder:
    """Keeps what kernels are called with. place: where the name of the kernel under way is written, for the parent."""

    def __init__(self, place: Path) -> None:
        self.calls: dict[str, list[tuple[Callable[..., int], list[Any]]]] = {}
        self._counts: dict[str, int] = {}
        self._place = place

    def wrap(self, name: str, function: Callable[..., int]) -> Callable[..., int]:
        """Return the function, recorded. Of more calls than are kept, later and later ones replace earlier ones."""

        def called(*arguments: Any) -> int:
            count = self._counts[name] = self._counts.get(name, 0) + 1
            kept = self.calls.setdefault(name, [])
            copies = [each.copy() if isinstance(each, np.ndarray) else each for each in arguments]
            if len(kept) < KEPT:
                kept.append((function, copies))
            elif count & (count - 1) == 0:
                kept[count.bit_length() % KEPT] = (function, copies)
            return self.call(name, function, arguments)

        return called

    def call(self, name: str, function: Callable[..., int], arguments: Sequence[Any]) -> int:
        """Call, after writing down who is called."""
        self._place.write_text(name, encoding="ascii")
        faulthandler.dump_traceback_later(LIMIT_SECONDS, exit=True)  # exit code 1
        status = function(*arguments)
        faulthandler.cancel_dump_traceback_later()
        return status


def audit_everything(rng: np.random.Generator, *, quick: bool) -> None:
    """Audit every lens, and damaged models."""
    from scripts.fuzzing import kernel_models as models  # noqa: PLC0415 - imports the audit, in the child only

    with tempfile.TemporaryDirectory(prefix="kernels-") as folder:
        place = Path(folder)
        for k, lens in enumerate(models.LENSES):
            numbers = (*rng.permutation(models.NUMBERS).tolist(), 301)
            for shared in (k % 2 == 0,) if quick else (False, True):
                model = models.lens_model(lens, rng, numbers, shared=shared)
                _audit(models.writer.write_binary(place / f"{k}{shared}", model))
        shared_model = models.lens_model(models.LENSES[2], rng, (120, 90, 70), shared=True)
        _audit(models.writer.write_binary(place / "shared", shared_model))
        _audit(models.writer.write_binary(place / "strip", models.strip_model(models.LENSES[2], rng, 40)))
        large = 40_000 if quick else 1_000_000
        _audit(
            models.writer.write_binary(
                place / "large", models.lens_model(models.LENSES[2], rng, (large, 60), shared=False)
            )
        )
        seed = int(rng.integers(2**31))
        for number in range(12 if quick else 300):
            case = models.model_case(seed, number)
            (place / str(number)).mkdir()
            models.write_case(case, place / str(number))
            _audit(place / str(number))
            shutil.rmtree(place / str(number))


def _audit(folder: Path) -> None:
    """Audit a model with everything; one that cannot be read is passed over."""
    from sfm_audit import open_model  # noqa: PLC0415 - in the child only
    from sfm_audit.audit.config import AuditConfig  # noqa: PLC0415
    from sfm_audit.audit.engine.model import audit_model  # noqa: PLC0415
    from sfm_audit.loaders import LoadError  # noqa: PLC0415

    try:
        model = open_model(str(folder))
    except LoadError:
        return
    audit_model(model, AuditConfig(covariance=True), observations=True)


def damaged(arguments: Sequence[Any], rng: np.random.Generator) -> list[Any]:
    """Return copies in which numbers of some arrays are others; whole numbers, which Python checks, stay."""
    out = []
    for each in arguments:
        value = each.copy() if isinstance(each, np.ndarray) else each
        is_numbers = isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size
        if is_numbers and rng.random() < 0.6:
            _damage(value.reshape(-1), rng)
        out.append(value)
    return out


def _damage(values: np.ndarray[Any, Any], rng: np.random.Generator) -> None:
    """Change one number, some, or all."""
    special = float(rng.choice(SPECIALS))
    match int(rng.integers(4)):
        case 0:
            values[int(rng.integers(values.size))] = special
        case 1:
            values[rng.random(values.size) < rng.random()] = special
        case 2:
            values[:] = special
        case _:
            with np.errstate(all="ignore"):
                values *= 10.0 ** float(rng.uniform(-320.0, 308.0))


def replay(recorder: Recorder, rng: np.random.Generator, minutes: float | None) -> int:
    """Call kernels again with damaged numbers, in turns, so often or for so long; return how often."""
    count = 0
    names = sorted(recorder.calls)
    end = time.monotonic() + 60.0 * (minutes or 0.0)
    for rounds in itertools.count():
        if not names or (rounds >= QUICK_ROUNDS if minutes is None else time.monotonic() > end):
            return count
        for name in names:
            kept = recorder.calls[name]
            function, arguments = kept[int(rng.integers(len(kept)))]
            if sum(each.size for each in arguments if isinstance(each, np.ndarray)) > 200_000 and rng.random() < 0.95:
                continue
            recorder.call(name, function, damaged(arguments, rng))
            count += 1
    return count


def child(library: Path, place: Path, seed: int, minutes: float | None) -> int:
    """Use the library with the sanitizers; return 1 where a kernel was never called."""
    from sfm_audit.audit.kernels import library as kernels  # noqa: PLC0415 - before anybody binds a kernel

    kernels.LIBRARY = library  # type: ignore[misc] # the one with sanitizers
    recorder = Recorder(place)
    prepare = kernels._prepared  # noqa: SLF001
    kernels._prepared = lambda name, types: recorder.wrap(name, prepare(name, types))  # type: ignore[assignment] # noqa: SLF001
    rng = np.random.default_rng(seed)
    started = time.process_time()
    with np.errstate(all="ignore"):
        for own in CALLS.values():
            own(rng)
        audit_everything(rng, quick=minutes is None)
        audited = time.process_time()
        count = replay(recorder, rng, minutes)
    getattr(ctypes.CDLL(None), CHECK_LEAKS)()  # says on stderr what nobody points to any more
    missing = sorted(symbols() - recorder.calls.keys())
    print(
        f"{len(recorder.calls)} kernels; audits {audited - started:.0f} s CPU, then {count} calls with damaged numbers"
    )
    for name in missing:
        print(f"fuzz_kernels: {name} was never called: add a case to CALLS")
    return 1 if missing else 0


def runtime(compiler: Sequence[str]) -> str | None:
    """Return the address sanitizer's library, which must be loaded before everything else; None without one."""
    asked = [*compiler, f"-print-file-name={RUNTIME}"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return found if Path(found).is_absolute() else None


def main() -> int:
    """Build, run, say what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="half a minute, the same inputs every time (.ci/run)")
    parser.add_argument("--minutes", type=float, default=5.0, help="of the second part")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--child", nargs=2, type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    seed = args.seed if args.seed is not None else 1 if args.quick else time.time_ns() % 2**31
    if args.child:
        library, place = args.child
        return child(library, place, seed, None if args.quick else args.minutes)
    compiler = build_kernels.compiler()
    preload = runtime(compiler) if compiler else None
    if compiler is None or preload is None:
        print("fuzz_kernels: no gcc with its address sanitizer on this machine, NOT TESTED")
        return 0
    with tempfile.TemporaryDirectory(prefix="kernels-") as folder:
        library, place = Path(folder) / build_kernels.LIBRARY.name, Path(folder) / "now"
        problem = build_kernels.build(library, list(SANITIZE))
        if problem is not None:
            print(f"fuzz_kernels: {problem}")
            return 1
        env = {
            **os.environ,
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
            "LD_PRELOAD": preload,
            "ASAN_OPTIONS": "leak_check_at_exit=0:allocator_may_return_null=1:malloc_context_size=8",
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "PYTHONMALLOC": "malloc",  # so that small arrays have borders too
            "ARROW_DEFAULT_MEMORY_POOL": "system",
            "SFM_AUDIT_KERNELS": "1",
        }
        options = ["--quick"] if args.quick else ["--minutes", str(args.minutes)]
        command = [sys.executable, __file__, "--child", str(library), str(place), "--seed", str(seed), *options]
        done = subprocess.run(command, env=env, check=False, stderr=subprocess.PIPE, text=True, errors="replace")
        if done.returncode:
            name = place.read_text(encoding="ascii") if place.exists() else "no kernel yet"
            print(f"{done.stderr}\nfuzz_kernels: ended by {done.returncode}, last in {name}; again with --seed {seed}")
            return 1
    leaks = kernel_leaks(done.stderr)
    for leak in leaks:
        print(leak)
    return 1 if leaks else 0


def kernel_leaks(said: str) -> list[str]:
    """Return the parts of a leak report about memory that kernels took; Python keeps much until it ends."""
    return [leak for leak in _LEAK.findall(said) if f"/{SOURCES_OF}/" in leak]


if __name__ == "__main__":
    sys.exit(main())
