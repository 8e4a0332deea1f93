"""What does an audit cost beside what pycolmap needs to load the same model? CPU seconds and memory, stage by stage.

    python scripts/bench.py                         b, s, w of 100, 1000, 5000 images and 100 models of 20: hours
    python scripts/bench.py --models b100 w1000     some of them
    python scripts/bench.py --write                 and put the tables into docs/performance.md
    python scripts/bench.py --quick                 60 images, one round; fails where a ratio leaves its band (--check)

b: a camera per image, s: one camera for all images, w: 2 % of the images with a lens that bends more than its model, t:
models of 20 images, audited together.
Everything is a process of its own with one thread and the files in the page cache, and takes turns in each round:
pycolmap's load, its load with `update_point_3d_errors`, our audit stage by stage with compiled kernels and with numpy
alone, `sfm-audit run` with --jobs 1 and 2 and without kernels. A ratio is taken within a round, then the median over
the rounds; its spread is their smallest and largest. Before a load and before the joint step memory is touched by
another process and given back (`have_pages`).
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve()
sys.path.insert(0, str(HERE.parents[1]))

from scripts.bench_page import COMPILED, JOINT, NUMPY, STAGES, Measured, Sample  # noqa: E402 - on the path only now

PAGE: Final = HERE.parents[1] / "docs" / "performance.md"
START, END = "<!-- made by scripts/bench.py -->", "<!-- end of what it makes -->"
SINGLE_THREADED: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
BYTES_PER_MAXRSS: Final = 1 if sys.platform == "darwin" else 1024
MODELS: Final = ("b100", "s100", "w100", "b1000", "s1000", "w1000", "b5000", "s5000", "w5000", "t100")
_MANY_ROUNDS: Final = 500
MAX_RATIO: Final = {"b60": (10.0, 25.0), "b100": (9.0, 20.0), "s100": (10.0, 22.0), "w100": (9.0, 20.0)}
"""Bands of --check, wide enough for a machine that others use, of the bold line's ratio: compiled, numpy."""
KERNELS: Final = "SFM_AUDIT_KERNELS"
RUN: Final = "from sfm_audit.audit.cli.main import entry_point; entry_point()"


_TOUCH: Final = """
import mmap
pages = mmap.mmap(-1, 2**30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
pages.madvise(mmap.MADV_HUGEPAGE)
for start in range(0, 2**30, 2**12):
    pages[start] = 1
"""


def have_pages() -> None:
    """Let another process touch a gigabyte and give it back, so that the system has it at hand (Linux).

    A virtual machine may give its free memory to its host, from which a first touch gets it again: up to 2 ms per MB,
    whoever asks. That says nothing of what is measured, and comes and goes with what ran before.
    """
    if hasattr(mmap, "MADV_HUGEPAGE"):
        subprocess.run([sys.executable, "-S", "-c", _TOUCH], check=False)


def load_pycolmap(folder: str) -> None:
    """What we are compared with."""
    import pycolmap  # noqa: PLC0415 - a stage imports what it needs, and no more

    have_pages()
    start = time.process_time()
    pycolmap.Reconstruction(folder)
    _say({"load": time.process_time() - start})


def load_and_update(folder: str) -> None:
    """Recompute all point errors too, the nearest that pycolmap has to an audit."""
    import pycolmap  # noqa: PLC0415

    have_pages()
    start = time.process_time()
    pycolmap.Reconstruction(folder).update_point_3d_errors()
    _say({"load": time.process_time() - start})


def audit(folder: str) -> None:
    """Audit stage by stage; the joint step late, so that memory without it can be told."""
    clock = _Laps()
    from sfm_audit.audit.schedule.imports import importing_audits  # noqa: PLC0415
    from sfm_audit.audit.schedule.memory import keep_freed  # noqa: PLC0415

    keep_freed()  # as the command line does, and the next
    with importing_audits():
        from sfm_audit.audit.engine.model import ModelAuditor  # noqa: PLC0415
        from sfm_audit.loaders import open_model  # noqa: PLC0415

    clock.lap("imports")
    have_pages()
    auditor = ModelAuditor(open_model(folder))
    clock.lap("read, check")
    _ = auditor.residuals, auditor.sigma_constant_px, auditor.tau_px
    clock.lap("residuals")
    _ = auditor.consistency
    clock.lap("consistency")
    _ = auditor.quality
    clock.lap("camera facts")
    _ = auditor.cameras
    clock.lap("cameras")
    _ = auditor.outside
    clock.lap("witnesses")
    _ = auditor.tracks
    clock.lap("tracks, prior")
    early_peak = peak_bytes()
    have_pages()
    _ = auditor.joint
    clock.lap(JOINT)
    auditor.tables()
    clock.lap("noise, tests, decisions, rows")
    _say(clock.parts, early_peak)


class _Laps:
    def __init__(self) -> None:
        self.parts: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, name: str) -> None:
        """Book the CPU time since the last lap."""
        now = time.process_time()
        self.parts[name], self._last = now - self._last, now


def _say(parts: Mapping[str, float], early_peak: float = 0.0) -> None:
    print(json.dumps({"parts": parts, "peak": peak_bytes(), "early_peak": early_peak}))


def peak_bytes() -> int:
    """Most memory this process ever held. Linux's ru_maxrss would count what its parent held when it started it."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii")) if status.exists() else None
    return int(found[1]) * 1024 if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_MAXRSS


PROCESSES: Final[dict[str, Callable[[str], None]]] = {
    "pycolmap": load_pycolmap,
    "pycolmap with errors": load_and_update,
    COMPILED: audit,
    NUMPY: audit,
}
NUMPY_RUN: Final = "`sfm-audit run --jobs 1`, numpy alone"


def measure(command: Sequence[str], *, kernels: bool = True, may_fail: bool = False) -> Sample:
    """Run a command; its CPU time with that of the processes it waited for."""
    start = time.perf_counter()
    env = {**os.environ, **SINGLE_THREADED, KERNELS: "1" if kernels else "0"}
    with subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL if may_fail else None, text=True
    ) as process:
        said = process.stdout.read() if process.stdout else ""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    if process.returncode and not may_fail:
        sys.exit(f"bench: {' '.join(command)} ended with exit code {process.returncode}")
    found = json.loads(said.splitlines()[-1]) if said.startswith("{") else {}
    peak = found.get("peak", usage.ru_maxrss * BYTES_PER_MAXRSS)
    cpu = usage.ru_utime + usage.ru_stime
    return Sample(cpu, wall, peak, found.get("parts", {}), found.get("early_peak", 0.0))


def commands(folder: Path, work: Path, *, with_runs: bool) -> dict[str, list[str]]:
    """Return what takes turns on one model, or on a folder of models."""
    runs = {f"`sfm-audit run --jobs {jobs}`": _run_command(folder, work / f"run{jobs}", jobs) for jobs in (1, 2)}
    runs[NUMPY_RUN] = _run_command(folder, work / "numpy", 1)
    if not any(folder.glob("*.bin")):
        return runs
    stages = {name: [sys.executable, str(HERE), "--stage", name, str(folder)] for name in PROCESSES}
    return {**stages, **runs} if with_runs else stages


def _run_command(folder: Path, run: Path, jobs: int) -> list[str]:
    return [sys.executable, "-c", RUN, "run", str(folder), "-o", str(run), "--quiet", "--jobs", str(jobs)]


def rounds(folder: Path, num_rounds: int, *, with_runs: bool = True) -> dict[str, list[Sample]]:
    """Measure everything that takes turns, round by round."""
    for path in folder.rglob("*.bin"):
        path.read_bytes()  # into the page cache
    samples: dict[str, list[Sample]] = {}
    for _ in range(num_rounds):
        with tempfile.TemporaryDirectory() as work:
            for name, command in commands(folder, Path(work), with_runs=with_runs).items():
                samples.setdefault(name, []).append(measure(command, kernels=name not in {NUMPY, NUMPY_RUN}))
    return samples


def simulate(folder: Path, num_images: int, kind: str = "b") -> str:
    """Write a simulated model of a kind; return what it holds, in words."""
    from sfm_audit.audit.simulate.dataset import DatasetSpec, scene_folder, write_dataset  # noqa: PLC0415

    if kind == "w":
        written = write_dataset(folder / "tree", DatasetSpec(1, num_images), 1)
        for path in scene_folder(folder / "tree", 0).rglob("*.bin"):
            path.rename(folder / path.name)
        return f"{written.num_images} images, {written.num_observations} observations"
    command = [sys.executable, str(HERE.with_name("simulate_large_model.py")), str(folder), "--images", str(num_images)]
    done = subprocess.run([*command, *["--shared"] * (kind == "s")], check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout.strip().removeprefix(f"{folder}: ").partition(";")[0]


def limits(folder: Path, num_observations: int) -> dict[str, float]:
    """Return seconds per stage that this machine needs for the bytes and the arithmetic of `STAGES`, in one thread."""
    import numpy as np  # noqa: PLC0415

    block, square = np.zeros(1 << 23), np.ones((600, 600))
    target = np.empty_like(block)
    copy_s = min(_seconds(lambda: np.copyto(target, block)) for _ in range(5))
    product_s = min(_seconds(lambda: square @ square) for _ in range(5))
    per_byte, per_operation = copy_s / (2.0 * block.nbytes), product_s / (2.0 * 600.0**3)
    out = {
        name: num_observations * (size * per_byte + operations * per_operation)
        for name, (size, operations) in STAGES.items()
    }
    out["read, check"] = sum(path.stat().st_size for path in folder.glob("*.bin")) * per_byte
    return out


def _seconds(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def measure_kind(kind: str, num_images: int, num_rounds: int, *, with_runs: bool = True) -> Measured:
    """Simulate a model, or with kind t a folder of ``num_images`` models of 20 images, and measure it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if kind == "t":
            from sfm_audit.audit.simulate.dataset import DatasetSpec, write_dataset  # noqa: PLC0415

            written = write_dataset(folder, DatasetSpec(num_images, 20, defects=0.0), 1)
            what = f"{written.num_images} images in {num_images} models, {written.num_observations} observations"
            return Measured(kind, what, rounds(folder, num_rounds))
        what = simulate(folder, num_images, kind)
        found = re.search(r"(\d+) observations", what)
        samples = rounds(folder, num_rounds, with_runs=with_runs)
        return Measured(kind, what, samples, limits(folder, int(found[1]) if found else 0))


def start_up(times: int) -> str:
    """Return what starting takes, as a table: a help text, an error, a small model on both paths.

    Modules are compiled as pip and scripts/bootstrap leave them, whatever this machine's environment says.
    """
    rooms = [str(PAGE.parents[1] / room) for room in ("audit", "loaders", "reports", "sfm_audit")]
    subprocess.run([sys.executable, "-I", "-m", "compileall", "-q", *rooms], check=False, stdout=subprocess.DEVNULL)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        simulate(folder / "model", 20)
        seconds: dict[str, list[float]] = {}
        for i in range(times):
            asked = {
                "`sfm-audit run --help`": [sys.executable, "-c", RUN, "run", "--help"],
                "`sfm-audit run`, of a PATH that is not there": _run_command(folder / "none", folder / "RUN", 1),
                "`sfm-audit run`, 20 images": _run_command(folder / "model", folder / f"{i}", 1),
                "`sfm-audit run`, 20 images, numpy alone": _run_command(folder / "model", folder / f"numpy{i}", 1),
            }
            for name, command in asked.items():
                sample = measure(command, kernels="numpy" not in name, may_fail="not there" in name)
                seconds.setdefault(name, []).append(sample.cpu)
        lines = ["| start-up | CPU, s |", "|---|---:|"]
        lines += [f"| {name} | {statistics.median(found):.2f} |" for name, found in seconds.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and where asked compare with the bands and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=MODELS, help="kind and number of images; t: of models of 20")
    parser.add_argument("--rounds", type=int, default=3, help="of models with up to 500 images; others have a third")
    parser.add_argument("--quick", action="store_true", help="b60, one round, stages alone, with --check")
    parser.add_argument("--check", action="store_true", help="fail where a ratio leaves its band")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/performance.md")
    parser.add_argument("--stage", choices=PROCESSES, help=argparse.SUPPRESS)
    parser.add_argument("folder", nargs="?", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.stage:
        PROCESSES[args.stage](args.folder)
        return 0
    if args.quick:
        args.models, args.rounds, args.check = ["b60"], 1, True
    lines, too_high = [f"{start_up(1 if args.quick else 5)}\n"], list[str]()
    print(lines[0])
    for name in args.models:
        kind, num = name[0], int(name[1:])
        num_rounds = args.rounds if num <= _MANY_ROUNDS else -(-args.rounds // 3)
        found = measure_kind(kind, num, num_rounds, with_runs=not args.quick)
        for line in found.lines():
            lines.append(line)
            print(line, flush=True)
        for path, band in zip((COMPILED, NUMPY), MAX_RATIO.get(name, ()), strict=False):
            if (ratio := found.plain_ratio(path)) > band:
                too_high.append(f"{name}, {path}: {ratio:.1f} times pycolmap's load, band {band:g}")
    if args.write:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
        made = "\n".join([START, *lines, END])
        PAGE.write_text(f"{before}{made}{rest.partition(END)[2]}", encoding="utf-8")
    print("\n".join(too_high), end="\n" * bool(too_high))
    return int(args.check and bool(too_high))


if __name__ == "__main__":
    sys.exit(main())
