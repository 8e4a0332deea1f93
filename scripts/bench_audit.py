"""Time and peak memory of load and audit, as ratios to what pycolmap needs to load the same files.

    python scripts/bench_audit.py [FOLDER]      1000 simulated images (simulate_large_model.py), or the model in FOLDER
    python scripts/bench_audit.py --quick       100 images

The stages are loading, loading + goodness of fit under the noise models constant and track, and loading + all tables.
Each measurement is a process of its own, single-threaded, with the files in the page cache; pycolmap's
`Reconstruction(path)` and our stages take turns, so that a busy machine disturbs all alike. Reported are medians over
the repetitions; time and memory include what the interpreter needs to start and to import, which is also given alone.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve()
SINGLE_THREADED: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
BYTES_PER_MAXRSS: Final = 1 if sys.platform == "darwin" else 1024


def load_pycolmap(folder: str) -> None:
    """What we are compared with."""
    import pycolmap  # noqa: PLC0415 - a stage imports what it needs, and no more

    pycolmap.Reconstruction(folder)


def import_audit(folder: str) -> None:
    """Nothing but imports."""
    del folder
    import sfm_audit.audit.engine.model  # noqa: PLC0415
    import sfm_audit.loaders  # noqa: PLC0415, F401


def load(folder: str) -> None:
    """Files to columns."""
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    open_model(folder)


def goodness_of_fit(folder: str) -> None:
    """Load, then residuals, noise models constant and track, and the tests of normality of every image."""
    from sfm_audit.audit.engine.model import ModelAuditor  # noqa: PLC0415
    from sfm_audit.audit.noise.standardise import constant_noise, track_noise  # noqa: PLC0415
    from sfm_audit.audit.normality import normality_tests  # noqa: PLC0415
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    auditor = ModelAuditor(open_model(folder))
    for image_idx in range(len(auditor.model.images)):
        constant = constant_noise(auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)])
        normality_tests(constant.z)
        normality_tests(track_noise(auditor.tracks, image_idx, constant.sigma_constant_px).z)


def everything(folder: str) -> None:
    """Load, then all tables: misfit, peeling, cameras, plausibility, verdicts."""
    from sfm_audit.audit.engine.model import audit_model  # noqa: PLC0415
    from sfm_audit.loaders import open_model  # noqa: PLC0415

    audit_model(open_model(folder))


STAGES: Final[dict[str, tuple[str, Callable[[str], None]]]] = {
    "pycolmap": ("pycolmap.Reconstruction(path)", load_pycolmap),
    "import": ("sfm-audit: imports alone", import_audit),
    "load": ("load", load),
    "gof": ("load + constant and track", goodness_of_fit),
    "all": ("load + everything", everything),
}


def run_stage(stage: str, folder: str) -> None:
    """Run one stage in this process and print what it took, as JSON. Import time counts, the interpreter's own not."""
    start = time.perf_counter()
    STAGES[stage][1](folder)
    seconds = time.perf_counter() - start
    print(json.dumps({"seconds": seconds, "peak_bytes": peak_bytes()}))


def peak_bytes() -> int:
    """Most memory this process ever held. Linux's ru_maxrss would count what its parent held when it started it."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii")) if status.exists() else None
    return int(found[1]) * 1024 if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_MAXRSS


def measure(stage: str, folder: Path) -> tuple[float, float]:
    """Return seconds and peak MB of one stage in a fresh process."""
    command = [sys.executable, str(HERE), "--stage", stage, str(folder)]
    done = subprocess.run(command, env={**os.environ, **SINGLE_THREADED}, check=True, stdout=subprocess.PIPE)
    found = json.loads(done.stdout.splitlines()[-1])
    return float(found["seconds"]), float(found["peak_bytes"]) / 1e6


def compare(folder: Path, repetitions: int) -> dict[str, tuple[float, float]]:
    """Return the median seconds and MB of every stage; the stages take turns."""
    for path in folder.iterdir():
        with path.open("rb") as file:  # into the page cache
            while file.read(1 << 20):
                pass
    samples: dict[str, list[tuple[float, float]]] = {stage: [] for stage in STAGES}
    for _ in range(repetitions):
        for stage in STAGES:
            samples[stage].append(measure(stage, folder))
    return {
        stage: (statistics.median(t for t, _ in found), statistics.median(m for _, m in found))
        for stage, found in samples.items()
    }


def table(medians: dict[str, tuple[float, float]]) -> list[str]:
    """Return a Markdown table of seconds, MB, and both as ratios to pycolmap's."""
    seconds, megabytes = medians["pycolmap"]
    lines = ["| | time, s | ratio | peak memory, MB | ratio |", "|---|---:|---:|---:|---:|"]
    for stage, (name, _) in STAGES.items():
        t, m = medians[stage]
        lines.append(f"| {name} | {t:.2f} | {t / seconds:.2f} | {m:.0f} | {m / megabytes:.2f} |")
    return lines


def simulate(folder: Path, num_images: int) -> str:
    """Write the simulated model; return what simulate_large_model.py says of it, without the path."""
    command = [sys.executable, str(HERE.with_name("simulate_large_model.py")), str(folder), "--images", str(num_images)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout.strip().removeprefix(f"{folder}: ").partition(";")[0]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a COLMAP model; simulated without")
    parser.add_argument("--quick", action="store_true", help="100 images, 3 repetitions")
    parser.add_argument("--repetitions", type=int, help="5; with --quick 3")
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.stage:
        run_stage(args.stage, str(args.folder))
        return 0
    repetitions = args.repetitions or (3 if args.quick else 5)
    with tempfile.TemporaryDirectory() as scratch:
        folder, what = args.folder, str(args.folder)
        if folder is None:
            folder = Path(scratch)
            what = simulate(folder, 100 if args.quick else 1000)
        medians = compare(folder, repetitions)
    print(f"{what}; medians of {repetitions}, one thread\n")
    print("\n".join(table(medians)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
