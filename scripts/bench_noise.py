"""CPU time of what is asked of residuals: tracks and their prior, noise of images, tests of normality.

    .venv/bin/python scripts/bench_noise.py [--images N] [--rounds N]

A simulated model of 2000 observations an image, numpy and the compiled kernels in turns; medians, ms per image.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.noise.stack import constant_fits, constant_noises, track_noises
from sfm_audit.audit.noise.standardise import track_noise
from sfm_audit.audit.normality import normality_tests_of
from sfm_audit.loaders import open_model

HERE = Path(__file__).resolve()
IMAGES_AT_ONCE = 64


class Laps:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the CPU time spent inside."""
        start = time.process_time()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - start


def measure(auditor: ModelAuditor) -> dict[str, float]:
    """Ask everything once; seconds by stage."""
    laps, residuals, num_images = Laps(), auditor.residuals, len(auditor.model.images)
    auditor.__dict__.pop("tracks", None)
    with laps.of("tracks, prior"):
        tracks = auditor.tracks
    with laps.of("constant noise"):
        fits = constant_fits(residuals)
    for start in range(0, num_images, IMAGES_AT_ONCE):
        part = range(start, min(start + IMAGES_AT_ONCE, num_images))
        with laps.of("constant noise"):
            constant = dict(zip(part, constant_noises(residuals, part, fits), strict=True))
        with laps.of("noise of tracks"):
            sigma_px = {k: noise.sigma_constant_px for k, noise in constant.items()}
            chosen = track_noises(tracks, part, sigma_px)
            for k in part:
                if k not in chosen:
                    chosen[k] = track_noise(tracks, k, sigma_px[k])
        with laps.of("normality, twice"):
            normality_tests_of([constant[k].z for k in part])
            normality_tests_of([chosen[k].z for k in part])
    return laps.seconds


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    paths = {"numpy": numpy_only} | ({"compiled": nullcontext} if kernels_in_use() else {})
    found: dict[str, list[dict[str, float]]] = {name: [] for name in paths}
    with (
        tempfile.TemporaryDirectory() as folder,
        threadpool_limits(limits=1, user_api="blas"),
        np.errstate(all="ignore"),
    ):
        large = [str(HERE.with_name("simulate_large_model.py")), folder, "--images", str(args.images)]
        subprocess.run([sys.executable, *large], check=True)
        auditor = ModelAuditor(open_model(folder))
        for _ in range(args.rounds):
            for name, path in paths.items():
                with path():
                    found[name].append(measure(auditor))
    print("| ms per image | " + " | ".join(paths) + " |")
    for stage in next(iter(found.values()))[0]:
        times = [float(np.median([each[stage] for each in rounds])) * 1e3 / args.images for rounds in found.values()]
        print(f"| {stage} | " + " | ".join(f"{ms:.3f}" for ms in times) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
