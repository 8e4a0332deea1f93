"""What does a data set cost? Audit 1, 2, 4, ... scenes of a simulated one: python scripts/bench_dataset.py.

A data set has many more scenes than are worth simulating, and its processes start once: the last run audits each scene
--copies times, by default nearly as many images and models as MegaDepth has, and what it takes is what counts.

Prints per run: images/s, observations/s, CPU per image, and the peak memory of the command and of its largest worker
process; then what that makes of MegaDepth and MegaScenes, on this machine and on a Dask cluster. With --quick a small
data set, and exit code 1 when memory grows with the number of scenes (.ci/run). docs/scale.md holds measured numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from sfm_audit.audit.simulate.dataset import DatasetSpec, scene_folder, write_dataset

MEGADEPTH = ("MegaDepth", 100_000, 196)  # registered images, models
MEGASCENES = ("MegaScenes", 2_000_000, 100_000)
NODES = (1, 4, 16, 64)
CORES_PER_NODE = 16
WRITES_PER_SECOND = 50.0  # models that one process writes to a disk with fsync; measured by this script where it can
POLL_SECONDS = 0.02, 0.2  # between two looks at memory, whose peak the system keeps: looking takes time from workers
MAX_MEMORY_GROWTH = 1.3  # of the largest process from one scene to all of them, in --quick


@dataclass(frozen=True, slots=True)
class Measured:
    """One audit of ``num_models`` models. seconds: wall clock.    own_mb, worker_mb: peak resident memory, MB."""

    num_models: int
    num_images: int
    num_observations: int
    seconds: float
    cpu_seconds: float
    own_mb: float
    worker_mb: float

    def line(self) -> str:
        """Return a row of the table."""
        per_image = 1e3 * self.cpu_seconds / self.num_images
        rates = f"{self.num_images / self.seconds:8.1f} {self.num_observations / self.seconds:12,.0f} {per_image:10.2f}"
        sizes = f"{self.num_models:6d} {self.num_images:8d} {self.num_observations:12,d}"
        return f"{sizes} {self.seconds:8.1f} {self.cpu_seconds:8.1f} {rates} {self.own_mb:8.0f} {self.worker_mb:9.0f}"


HEADER = "models   images observations   wall s    CPU s images/s        obs/s CPU ms/im.   MB own MB worker"


def measure(paths: Sequence[Path], run: Path, options: Sequence[str]) -> Measured:
    """Audit models in a process of its own; its workers are its children."""
    code = "from sfm_audit.audit.cli.main import entry_point; entry_point()"
    command = [sys.executable, "-c", code, "run", *map(str, paths), "-o", str(run), "--quiet", *options]
    start, cpu_before = time.perf_counter(), os.times()
    peaks: dict[int, float] = {}
    with subprocess.Popen(command) as process:
        while process.poll() is None:
            for pid in (process.pid, *_descendants(process.pid)):
                peaks[pid] = max(peaks.get(pid, 0.0), _peak_mb(pid))
            time.sleep(float(np.clip((time.perf_counter() - start) / 50, *POLL_SECONDS)))  # little is missed at the end
    seconds, cpu_after = time.perf_counter() - start, os.times()
    if process.returncode:
        sys.exit(f"bench_dataset: sfm-audit run ended with exit code {process.returncode}")
    cpu = sum(cpu_after[2:4]) - sum(cpu_before[2:4])  # of children that have ended
    own = peaks.pop(process.pid)
    models = pq.read_table(run / "models", columns=["num_images", "num_observations"])
    num_images, num_observations = (int(np.sum(models[name].to_numpy())) for name in models.column_names)
    return Measured(len(models), num_images, num_observations, seconds, cpu, own, max(peaks.values(), default=0.0))


def _descendants(pid: int) -> Iterator[int]:
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        children = [child for task in tasks for child in (task / "children").read_text(encoding="ascii").split()]
    except OSError:
        return
    for child in map(int, children):
        yield child
        yield from _descendants(child)


def _peak_mb(pid: int) -> float:
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")), 0.0)


def curve(root: Path, num_scenes: int, num_copies: int, options: Sequence[str], work: Path) -> list[Measured]:
    """Audit 1, 2, 4, ... and all scenes, then all with their copies; print a line for each."""
    print(HEADER)
    paths = [scene_folder(root, i) for i in range(num_scenes)]
    for k in range(1, num_copies):
        paths += [_copied(scene_folder(root, i), scene_folder(work / f"copy{k}", i)) for i in range(num_scenes)]
    counts = sorted({*(2**k for k in range(num_scenes.bit_length())), num_scenes, len(paths)})
    out = []
    for count in counts:
        out.append(measure(paths[:count], work / f"run{count}", options))
        print(out[-1].line(), flush=True)
    return out


def _copied(scene: Path, to: Path) -> Path:
    """The same scene at another place, which is returned; it takes no disk space where that can be."""
    try:
        shutil.copytree(scene, to, copy_function=os.link)
    except (OSError, shutil.Error):  # another disk, or one without links
        shutil.rmtree(to, ignore_errors=True)
        shutil.copytree(scene, to)
    return to


def extrapolate(large: Measured, small: Measured, num_cores: int) -> None:
    """Print what MegaDepth and MegaScenes take, from models of hundreds of images and from small ones."""
    for (name, images, models), at in ((MEGADEPTH, large), (MEGASCENES, small)):
        cpu = at.cpu_seconds / at.num_images * images
        wall = at.seconds / at.num_images * images
        print(
            f"{name}: {images:,} images in {models:,} models: {cpu / 3600:.2f} CPU hours; "
            f"{wall / 60:.1f} minutes at the rate measured here, {cpu / num_cores / 60:.1f} minutes if {num_cores} "
            "cores were this run's alone"
        )
        for nodes in NODES:
            seconds = max(cpu / (nodes * CORES_PER_NODE), models / WRITES_PER_SECOND)
            print(f"  Dask, {nodes:2d} nodes of {CORES_PER_NODE} cores: {seconds / 60:6.1f} minutes")


def main() -> None:
    """Parse arguments, simulate, measure, extrapolate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small data set, and a check of the memory")
    parser.add_argument("--scenes", type=int, default=16, help="with few, starting processes counts much")
    parser.add_argument("--copies", type=int, default=12, help="of each scene, in the last run")
    parser.add_argument("--images", type=int, default=500, help="per scene")
    parser.add_argument("--small-scenes", type=int, default=100, help="of --small-images images, as in MegaScenes")
    parser.add_argument("--small-images", type=int, default=20)
    parser.add_argument("--defects", type=float, default=0.02, help="share of images with a planted lens defect")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--dask", help="passed on to sfm-audit run")
    parser.add_argument("--data", type=Path, help="where the simulated trees are kept and looked for")
    parser.add_argument("--json", type=Path, help="write the measured numbers there")
    args = parser.parse_args()
    if args.quick:
        args.scenes, args.copies, args.images, args.small_scenes, args.small_images = 3, 1, 15, 3, 8
    options = ["--jobs", str(args.jobs), *(["--dask", args.dask] if args.dask else [])]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        data = args.data or work
        large = _data(data / "large", DatasetSpec(args.scenes, args.images, defects=args.defects), args.jobs)
        small = _data(data / "small", DatasetSpec(args.small_scenes, args.small_images, defects=0.0), args.jobs)
        print(f"{args.scenes} scenes of {args.images} images, {args.defects:.0%} of them wrong; {' '.join(options)}")
        curve_large = curve(large, args.scenes, args.copies, options, work)
        print(f"{args.small_scenes} scenes of {args.small_images} images")
        print(HEADER)
        at_small = measure([small], work / "small_run", options)
        print(at_small.line())
    if not args.quick:
        extrapolate(curve_large[-1], at_small, args.jobs)
    if args.json:
        fields = Measured.__slots__
        rows = [{name: getattr(row, name) for name in fields} for row in (*curve_large, at_small)]
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if args.quick:
        _check_memory(curve_large)


def _data(root: Path, spec: DatasetSpec, jobs: int) -> Path:
    mark = root / "spec.txt"
    if not mark.exists() or mark.read_text(encoding="utf-8") != repr(spec):
        write_dataset(root, spec, jobs)
        mark.write_text(repr(spec), encoding="utf-8")
    return root


def _check_memory(runs: Sequence[Measured]) -> None:
    one, most = (max(run.own_mb, run.worker_mb) for run in (runs[0], runs[-1]))
    if most > MAX_MEMORY_GROWTH * one:
        sys.exit(f"bench_dataset: one scene takes {one:.0f} MB, {runs[-1].num_models} scenes {most:.0f} MB")


if __name__ == "__main__":
    main()
