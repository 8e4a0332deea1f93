"""Cost of the joint step beside pycolmap's bundle adjustment of the same model, and beside the rest of the audit.

    python scripts/bench_joint.py [FOLDER]      1000 simulated images (simulate_large_model.py), or the model in FOLDER
    python scripts/bench_joint.py --quick       100 images; fails where a ratio leaves its bound

Compared are CPU seconds of the joint step (system, own parameters, implied parameters, misfit, covariances; method.md
sections 11 and 11b) with those of `pycolmap.bundle_adjustment`, stopped after three iterations, and peak memory of the
whole audit with that of an audit without the joint step. Each measurement is a process of its own, single-threaded;
the stages take turns, so that a busy machine disturbs all alike. Reported are medians over the repetitions.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

if __package__ in (None, ""):  # called by its path
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scripts.bench import SINGLE_THREADED, peak_bytes, simulate

HERE: Final = Path(__file__).resolve()
ITERATIONS: Final = 3
MAX_TIME_RATIO: Final = 1.0
MAX_MEMORY_RATIO: Final = 2.0


def adjust(folder: str) -> float:
    """CPU seconds of pycolmap's bundle adjustment, poses, points and own parameters free."""
    import pycolmap  # noqa: PLC0415 - a stage imports what it needs, and no more

    reconstruction = pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, ITERATIONS
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    start = time.process_time()
    pycolmap.bundle_adjustment(reconstruction, options)
    return time.process_time() - start


def audit_plainly(folder: str) -> float:
    """CPU seconds of what the audit computes without the joint step."""
    from sfm_audit.audit.engine.model import ModelAuditor  # noqa: PLC0415
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    auditor = ModelAuditor(open_model(folder))
    start = time.process_time()
    _ = auditor.consistency, auditor.tau_px, auditor.tracks, auditor.quality, auditor.cameras
    return time.process_time() - start


def audit_jointly(folder: str) -> float:
    """CPU seconds of the joint step alone; the rest of the audit was there before it."""
    from sfm_audit.audit.engine.model import ModelAuditor  # noqa: PLC0415
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    auditor = ModelAuditor(open_model(folder))
    _ = auditor.consistency, auditor.tau_px, auditor.residuals
    start = time.process_time()
    _ = auditor.joint
    seconds = time.process_time() - start
    auditor.tables()
    return seconds


STAGES: Final[dict[str, tuple[str, Callable[[str], float]]]] = {
    "pycolmap": (f"pycolmap.bundle_adjustment, {ITERATIONS} iterations", adjust),
    "plain": ("audit without the joint step", audit_plainly),
    "joint": ("joint step; peak of the whole audit", audit_jointly),
}


def run_stage(stage: str, folder: str) -> None:
    """Run one stage in this process and print what it took, as JSON."""
    seconds = STAGES[stage][1](folder)
    print(json.dumps({"seconds": seconds, "peak_bytes": peak_bytes()}))


def measure(stage: str, folder: Path) -> tuple[float, float]:
    """Return CPU seconds and peak MB of one stage in a fresh process."""
    command = [sys.executable, str(HERE), "--stage", stage, str(folder)]
    done = subprocess.run(command, env={**os.environ, **SINGLE_THREADED}, check=True, stdout=subprocess.PIPE)
    found = json.loads(done.stdout.splitlines()[-1])
    return float(found["seconds"]), float(found["peak_bytes"]) / 1e6


def compare(folder: Path, repetitions: int) -> dict[str, tuple[float, float]]:
    """Return the median seconds and MB of every stage."""
    samples: dict[str, list[tuple[float, float]]] = {stage: [] for stage in STAGES}
    for _ in range(repetitions):
        for stage in STAGES:
            samples[stage].append(measure(stage, folder))
    return {
        stage: (statistics.median(t for t, _ in found), statistics.median(m for _, m in found))
        for stage, found in samples.items()
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and with --quick compare with the bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a COLMAP model; simulated without")
    parser.add_argument("--quick", action="store_true", help="100 images, one repetition, with bounds")
    parser.add_argument("--repetitions", type=int, help="3; with --quick 1")
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.stage:
        run_stage(args.stage, str(args.folder))
        return 0
    repetitions = args.repetitions or (1 if args.quick else 3)
    with tempfile.TemporaryDirectory() as scratch:
        folder, what = args.folder, str(args.folder)
        if folder is None:
            folder = Path(scratch)
            what = simulate(folder, 100 if args.quick else 1000)
        medians = compare(folder, repetitions)
    print(f"{what}; medians of {repetitions}, one thread\n")
    print("| | CPU time, s | peak memory, MB |\n|---|---:|---:|")
    for stage, (name, _) in STAGES.items():
        print(f"| {name} | {medians[stage][0]:.1f} | {medians[stage][1]:.0f} |")
    time_ratio = medians["joint"][0] / medians["pycolmap"][0]
    memory_ratio = medians["joint"][1] / medians["plain"][1]
    print(f"\njoint step / bundle adjustment: {time_ratio:.2f}; peak memory / audit without it: {memory_ratio:.2f}")
    return int(args.quick and (time_ratio > MAX_TIME_RATIO or memory_ratio > MAX_MEMORY_RATIO))


if __name__ == "__main__":
    sys.exit(main())
