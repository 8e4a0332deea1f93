"""What does an audit cost beside what pycolmap needs to load the same model? CPU seconds and memory, stage by stage.

    python scripts/bench.py                         b, s, w of 100, 1000, 5000 images and 100 models of 20: hours
    python scripts/bench.py --models b100 w1000     some of them
    python scripts/bench.py --write                 and put the tables into docs/performance.md
    python scripts/bench.py --quick                 60 images, one round; fails where a ratio leaves its band (--check)

b: a camera per image, s: one camera for all images, w: 2 % of the images with a lens that bends more than its model, t:
models of 20 images, audited together.
Everything is a process of its own with one thread and the files in the page cache, and takes turns in each round:
pycolmap's load, its load with `update_point_3d_errors`, our audit stage by stage, `sfm-audit run` in one and in two
processes. A ratio is taken within a round, then the median over the rounds; its spread is their smallest and largest.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve()
PAGE: Final = HERE.parents[1] / "docs" / "performance.md"
START, END = "<!-- made by scripts/bench.py -->", "<!-- end of what it makes -->"
SINGLE_THREADED: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
BYTES_PER_MAXRSS: Final = 1 if sys.platform == "darwin" else 1024
KINDS: Final = {
    "b": "a camera per image",
    "s": "one camera for all",
    "w": "2 % of the images wrong",
    "t": "small models",
}
MODELS: Final = ("b100", "s100", "w100", "b1000", "s1000", "w1000", "b5000", "s5000", "w5000", "t100")
_MANY_ROUNDS: Final = 500
JOINT: Final = "joint step and joint test"
MAX_RATIO: Final = {"b60": 40.0, "b100": 30.0, "s100": 35.0, "w100": 30.0, "b400": 25.0}
"""Bands of --check, wide enough for a machine that others use, of the bold line's ratio."""

STAGES: Final[Mapping[str, tuple[int, int]]] = {
    "imports": (0, 0),
    "read, check": (0, 0),
    "residuals": (136, 210),
    "consistency": (64, 300),
    "tracks, prior": (260, 730),
    "camera facts": (136, 7300),
    "cameras": (0, 0),
    "witnesses": (0, 0),
    JOINT: (300, 27_000),
    "noise, tests, decisions, rows": (80, 900),
}
"""Bytes and floating point operations per observation that a stage cannot do without (SIMPLE_RADIAL, tracks of 5).

read: the files, once. residuals: observation, index and point in, residual and Jacobians out. tracks: three passes over
the Jacobians; seven evaluations of the prior's likelihood. camera facts: the triangle of the Gram matrix of 8 nuisance
and 42 candidate columns and that of the meat. joint: 42 fields against the 8 columns of five views of each track, there
and back. noise, tests: two sorts, two transformations. What a stage costs once per image is not in here.
"""


@dataclass(frozen=True, slots=True)
class Sample:
    """One process. cpu, wall: s.    peak, early_peak: bytes, at the end and before the joint step.

    parts: CPU seconds by stage.
    """

    cpu: float
    wall: float
    peak: float
    parts: Mapping[str, float] = field(default_factory=dict)
    early_peak: float = 0.0

    @property
    def plain(self) -> float:
        """CPU of all stages but the joint ones and the imports."""
        return sum(seconds for name, seconds in self.parts.items() if name not in {JOINT, "imports"})


def load_pycolmap(folder: str) -> None:
    """What we are compared with."""
    import pycolmap  # noqa: PLC0415 - a stage imports what it needs, and no more

    start = time.process_time()
    pycolmap.Reconstruction(folder)
    _say({"load": time.process_time() - start})


def load_and_update(folder: str) -> None:
    """Recompute all point errors too, the nearest that pycolmap has to an audit."""
    import pycolmap  # noqa: PLC0415

    start = time.process_time()
    pycolmap.Reconstruction(folder).update_point_3d_errors()
    _say({"load": time.process_time() - start})


def audit(folder: str) -> None:
    """Audit stage by stage; the joint step late, so that memory without it can be told."""
    clock = _Laps()
    from sfm_audit.audit.engine.model import ModelAuditor  # noqa: PLC0415
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    clock.lap("imports")
    auditor = ModelAuditor(open_model(folder))
    clock.lap("read, check")
    _ = auditor.residuals, auditor.sigma_constant_px, auditor.tau_px
    clock.lap("residuals")
    _ = auditor.consistency
    clock.lap("consistency")
    _ = auditor.tracks
    clock.lap("tracks, prior")
    _ = auditor.quality
    clock.lap("camera facts")
    _ = auditor.cameras
    clock.lap("cameras")
    _ = auditor.outside
    clock.lap("witnesses")
    early_peak = peak_bytes()
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
    "audit": audit,
}


def measure(command: Sequence[str]) -> Sample:
    """Run a command; its CPU time with that of the processes it waited for."""
    start = time.perf_counter()
    with subprocess.Popen(command, env={**os.environ, **SINGLE_THREADED}, stdout=subprocess.PIPE, text=True) as process:
        said = process.stdout.read() if process.stdout else ""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    if process.returncode:
        sys.exit(f"bench: {' '.join(command)} ended with exit code {process.returncode}")
    found = json.loads(said.splitlines()[-1]) if said.startswith("{") else {}
    peak = found.get("peak", usage.ru_maxrss * BYTES_PER_MAXRSS)
    cpu = usage.ru_utime + usage.ru_stime
    return Sample(cpu, wall, peak, found.get("parts", {}), found.get("early_peak", 0.0))


def commands(folder: Path, work: Path, *, with_runs: bool) -> dict[str, list[str]]:
    """Return what takes turns on one model, or on a folder of models."""
    run = "from sfm_audit.audit.cli.main import entry_point; entry_point()"
    out = {
        f"{jobs} process{'es' * (jobs > 1)}": _run_command(run, folder, work / f"run{jobs}", jobs) for jobs in (1, 2)
    }
    if not any(folder.glob("*.bin")):
        return out
    stages = {name: [sys.executable, str(HERE), "--stage", name, str(folder)] for name in PROCESSES}
    return {**stages, **out} if with_runs else stages


def _run_command(code: str, folder: Path, run: Path, jobs: int) -> list[str]:
    return [sys.executable, "-c", code, "run", str(folder), "-o", str(run), "--quiet", "--jobs", str(jobs)]


def rounds(folder: Path, num_rounds: int, *, with_runs: bool = True) -> dict[str, list[Sample]]:
    """Measure everything that takes turns, round by round."""
    for path in folder.rglob("*.bin"):
        path.read_bytes()  # into the page cache
    samples: dict[str, list[Sample]] = {}
    for _ in range(num_rounds):
        with tempfile.TemporaryDirectory() as work:
            for name, command in commands(folder, Path(work), with_runs=with_runs).items():
                samples.setdefault(name, []).append(measure(command))
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


@dataclass(frozen=True, slots=True)
class Measured:
    """One model, or a folder of small ones. what: its size in words.    limit_s: see `limits`."""

    kind: str
    what: str
    samples: Mapping[str, Sequence[Sample]]
    limit_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def num_images(self) -> int:
        """As ``what`` says."""
        return int(self.what.split()[0])

    @property
    def loads(self) -> list[float]:
        """CPU seconds of pycolmap's load, by round."""
        return [sample.parts["load"] for sample in self.samples["pycolmap"]]

    def of_stage(self, name: str) -> list[float]:
        """CPU seconds of a stage, by round."""
        return [sample.parts[name] for sample in self.samples["audit"]]

    @property
    def plain_ratio(self) -> float:
        """Audit without the joint step and imports / load."""
        return statistics.median(own.plain / load for own, load in zip(self.samples["audit"], self.loads, strict=True))

    def lines(self) -> Iterator[str]:
        """Yield a title and two tables, in Markdown."""
        num_rounds = max(map(len, self.samples.values()))
        times = "one round" if num_rounds == 1 else f"{num_rounds} rounds"
        yield f"### {self.kind}: {KINDS[self.kind]}; {self.what}; {times}\n"
        if "audit" in self.samples:
            yield "| | CPU ms per image | limit, ms | ratio to pycolmap's load | spread |\n|---|---:|---:|---:|---:|"
            yield self._row("pycolmap: load", self.loads)
            errors = [sample.parts["load"] for sample in self.samples["pycolmap with errors"]]
            yield self._row("pycolmap: load, `update_point_3d_errors`", errors)
            for name in STAGES:
                if name not in {"imports", JOINT}:
                    yield self._row(name, self.of_stage(name), self.limit_s[name])
            plain = sum(seconds for name, seconds in self.limit_s.items() if name != JOINT)
            yield self._row("**all without the joint step**", [own.plain for own in self.samples["audit"]], plain)
            yield f"{self._row(JOINT, self.of_stage(JOINT), self.limit_s[JOINT])}\n"
        yield from self._processes()

    def _row(self, name: str, seconds: Sequence[float], limit_s: float = 0.0) -> str:
        """One line of the first table."""
        per_image = 1e3 / self.num_images
        found = [own / load for own, load in zip(seconds, self.loads, strict=True)]
        limit = f"{limit_s * per_image:.2f}" if limit_s else ""
        spread = f"{statistics.median(found):.2f} | {min(found):.2f} .. {max(found):.2f}"
        return f"| {name} | {statistics.median(seconds) * per_image:.2f} | {limit} | {spread} |"

    def _processes(self) -> Iterator[str]:
        """Yield the table of whole processes, imports included."""
        yield "| whole process | CPU, s | wall, s | peak memory, MB |\n|---|---:|---:|---:|"
        for name, samples in self.samples.items():
            cpu, wall, peak = (
                statistics.median(values)
                for values in zip(*((each.cpu, each.wall, each.peak / 1e6) for each in samples), strict=True)
            )
            shown = name if name in PROCESSES else f"`sfm-audit run`, {name}"
            yield f"| {shown} | {cpu:.2f} | {wall:.2f} | {peak:.0f} |"
            if early := [each.early_peak for each in samples if each.early_peak]:
                yield f"| of it before the joint step | | | {statistics.median(early) / 1e6:.0f} |"
        yield ""


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
    """Return what `sfm-audit run --help` takes, in words."""
    code = "from sfm_audit.audit.cli.main import entry_point; entry_point()"
    samples = [measure([sys.executable, "-c", code, "run", "--help"]) for _ in range(times)]
    return f"`sfm-audit run --help`: {statistics.median(sample.cpu for sample in samples):.2f} s CPU."


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
    lines, too_high = [f"{start_up(1 if args.quick else 5)}\n"], []
    print(lines[0])
    for name in args.models:
        kind, num = name[0], int(name[1:])
        num_rounds = args.rounds if num <= _MANY_ROUNDS else -(-args.rounds // 3)
        found = measure_kind(kind, num, num_rounds, with_runs=not args.quick)
        for line in found.lines():
            lines.append(line)
            print(line, flush=True)
        if name in MAX_RATIO and found.plain_ratio > MAX_RATIO[name]:
            too_high.append(f"{name}: {found.plain_ratio:.1f} times pycolmap's load, band {MAX_RATIO[name]:g}")
    if args.write:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
        made = "\n".join([START, *lines, END])
        PAGE.write_text(f"{before}{made}{rest.partition(END)[2]}", encoding="utf-8")
    print("\n".join(too_high), end="\n" * bool(too_high))
    return int(args.check and bool(too_high))


if __name__ == "__main__":
    sys.exit(main())
