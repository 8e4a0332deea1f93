"""What does a compiled kernel gain over its numpy twin? Both paths in turns, on one simulated model.

    python scripts/bench_kernels.py                  all subjects, 100 images with 2000 observations each
    python scripts/bench_kernels.py projection --images 400 --shared
    python scripts/bench_kernels.py --folder MODEL   of a model that lies somewhere

CPU time of one thread, ms per image: the fastest of the rounds. docs/kernels.md has the numbers.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from sfm_audit.audit.consistency import consistency_of
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.quality import spread_of_images
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import numpy_only, path_taken
from sfm_audit.audit.misfit.camera_sums import camera_tests_of_sums
from sfm_audit.audit.misfit.images import misfit_of_images
from sfm_audit.audit.misfit.sums import ModelSums
from sfm_audit.audit.witnesses.asking import ask
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.loaders import open_model
from sfm_audit.loaders.evidence import NOTHING_GIVEN
from sfm_audit.loaders.model import SparseModel

ROUNDS: Final = 5


def projection(model: SparseModel) -> Callable[[], object]:
    """Residuals and derivatives of all observations."""
    return lambda: model_residuals(model)


def consistency(model: SparseModel) -> Callable[[], object]:
    """Whether the parts of each image belong together."""
    residuals = model_residuals(model)
    return lambda: consistency_of(model, residuals)


def misfit(model: SparseModel) -> Callable[[], object]:
    """Misfit tests of all images, as the model stands."""
    residuals = model_residuals(model)
    return lambda: misfit_of_images(ModelSums(model, residuals), range(len(model.images)))


def cameras(model: SparseModel) -> Callable[[], object]:
    """Misfit tests of the first camera, pooled over its images, which were tested before."""
    residuals = model_residuals(model)
    images = np.flatnonzero(model.images.camera_idx == 0).tolist()
    tested = misfit_of_images(ModelSums(model, residuals), images)
    known = {image: each.sums for image, each in tested.items() if each.sums is not None}
    return lambda: camera_tests_of_sums(ModelSums(model, residuals, known), images)


def spread(model: SparseModel) -> Callable[[], object]:
    """Hull, occupied cells and median depth of all images."""
    residuals, images = model_residuals(model), range(len(model.images))
    cameras = [model.camera(int(idx)) for idx in model.images.camera_idx]
    return lambda: spread_of_images(cameras, model, residuals, images, 8)


def witnesses(model: SparseModel) -> Callable[[], object]:
    """What the model says of its images outside of each: who shares points with whom, who should see what."""
    auditor = ModelAuditor(model)
    given = model, auditor.residuals, auditor.sigma_constant_px, NOTHING_GIVEN
    return lambda: ask(Evidence.of(*given))


SUBJECTS: Final[dict[str, Callable[[SparseModel], Callable[[], object]]]] = {
    "projection": projection,
    "consistency": consistency,
    "misfit": misfit,
    "cameras": cameras,
    "spread": spread,
    "witnesses": witnesses,
}
"""From a model to what is timed; what it needs of the model is made before."""


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    call()
    return time.process_time() - start


def compare(name: str, model: SparseModel) -> str:
    """Return one line: both paths and their ratio."""
    call = SUBJECTS[name](model)
    compiled, plain = [], []
    for _ in range(ROUNDS):
        compiled.append(seconds(call))
        with numpy_only():
            plain.append(seconds(call))
    per_image = 1e3 / max(len(model.images), 1)
    fast, slow = min(compiled) * per_image, min(plain) * per_image
    return f"{name:12s} numpy {slow:7.3f}   compiled {fast:7.3f} ms per image   {slow / fast:5.1f} x"


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate or open a model, and time the subjects."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", help=f"of {', '.join(SUBJECTS)}; all when none is named")
    parser.add_argument("--images", type=int, default=100, help="of the simulated model")
    parser.add_argument("--shared", action="store_true", help="one camera for all images")
    parser.add_argument("--folder", help="a model, instead of a simulated one")
    args = parser.parse_args(arguments)
    if unknown := set(args.subjects) - set(SUBJECTS):
        parser.error(f"no such subject: {', '.join(sorted(unknown))}; there are {', '.join(SUBJECTS)}")
    taken = path_taken()
    print(f"{taken.name}: {taken.reason}")
    with tempfile.TemporaryDirectory() as scratch, threadpool_limits(1, "blas"), np.errstate(all="ignore"):
        folder = args.folder or scratch
        if not args.folder:
            simulator = Path(__file__).with_name("simulate_large_model.py")
            command = [sys.executable, str(simulator), scratch, "--images", str(args.images)]
            subprocess.run([*command, *["--shared"] * args.shared], check=True)
        model = open_model(folder)
        for name in args.subjects or SUBJECTS:
            print(compare(name, model))
    return 0


if __name__ == "__main__":
    sys.exit(main())
