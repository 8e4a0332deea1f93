"""Measure: is the gate green when COLMAP reconstructs the same photos again, and red when something is wrong.

Extracts and matches features once, then, for each seed, verifies the matches, maps the photos and audits what comes
out; learns the band from the first reconstructions and checks the others against the first of them. Then one fault at a
time is planted into a reconstruction that passed. Exit code 1 when a sound one is red, or a fault is green.

    python scripts/study_nightly.py [--quick] [--photos FOLDER]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from shutil import copyfile

import numpy as np
import pycolmap

from sfm_audit.audit.cli.main import main as sfm_audit

PHOTOS = (
    Path(__file__).resolve().parents[2] / "shared/corpus/megadepth_like/MegaDepth_v1_SfM/9001/images"
)  # ten of MegaDepth's


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="learn from 3, check 5 (not 5 and 15)")
    parser.add_argument("--photos", type=Path, default=PHOTOS)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if not args.photos.is_dir():
        print(f"no photos at {args.photos}: nothing is studied (--photos FOLDER)")
        return 0
    num_learn, num_check = (3, 5) if args.quick else (5, 15)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with tempfile.TemporaryDirectory() as name:
        return study(Path(name), args.photos, num_learn, num_check, args.threads)


def study(work: Path, photos: Path, num_learn: int, num_check: int, num_threads: int) -> int:
    """Reconstruct, learn, check; print a line per check."""
    start = time.perf_counter()
    match_photos(work / "database.db", photos, num_threads)
    print(f"features and matches: {time.perf_counter() - start:.1f} s")
    for seed in range(num_learn + num_check):
        reconstruct(work, photos, seed)
        audited(work, f"{seed}")
    print(f"{num_learn + num_check} reconstructions audited: {time.perf_counter() - start:.1f} s")
    gate = work / "gate.toml"
    call("learn-band", *(work / f"run-{seed}" for seed in range(num_learn)), "-o", gate)
    print(gate.read_text(encoding="utf-8"))
    wrong = [f"seed {seed}" for seed in range(num_learn, num_learn + num_check) if not passes(work, f"{seed}", gate)]
    for name, plant in PLANTED.items():
        target = work / name / "photos/sparse/0"
        target.mkdir(parents=True)
        faulty = pycolmap.Reconstruction(str(largest(work / f"{num_learn}")))
        plant(faulty)
        faulty.write(str(target))
        audited(work, name)
        if passes(work, name, gate):
            wrong.append(name)
    print(f"{time.perf_counter() - start:.1f} s in all")
    for name in wrong:
        print(f"OUT OF BOUNDS: {name}", file=sys.stderr)
    return 1 if wrong else 0


def match_photos(database: Path, photos: Path, num_threads: int) -> None:
    """Extract SIFT features and match all pairs, on the CPU."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = num_threads, False
    pycolmap.extract_features(
        database, photos, camera_mode=pycolmap.CameraMode.PER_IMAGE, extraction_options=extraction
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = num_threads, False
    pycolmap.match_exhaustive(database, matching_options=matching)


def reconstruct(work: Path, photos: Path, seed: int) -> None:
    """Verify the matches and map, both with a seed of their own; the folder is called photos each time."""
    folder = work / f"{seed}"
    (folder / "photos/sparse").mkdir(parents=True)
    database = folder / "database.db"
    copyfile(work / "database.db", database)
    with contextlib.closing(pycolmap.Database.open(database)) as opened:
        opened.clear_two_view_geometries()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.geometric_verification(database, two_view_geometry_options=verification)
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed, mapping.min_model_size = seed, 3
    pycolmap.incremental_mapping(database, photos, folder / "photos/sparse", mapping)


def largest(folder: Path) -> Path:
    """The model with most images of a reconstruction."""
    models = sorted((folder / "photos/sparse").iterdir())
    return max(models, key=lambda path: pycolmap.Reconstruction(str(path)).num_reg_images())


def audited(work: Path, name: str) -> None:
    """Audit a reconstruction into run-<name>."""
    call("run", work / name / "photos", "-o", work / f"run-{name}", "--jobs", "1", "--quiet")


def passes(work: Path, name: str, gate: Path) -> bool:
    """Check a run against the first reconstruction's."""
    report = work / f"{name}.json"
    code = call(*("check", work / f"run-{name}", "--policy-file", gate, "--baseline", work / "run-0", "--json", report))
    checks = json.loads(report.read_bytes())["checks"]
    failed = ", ".join(check["check"].removeprefix("band.") for check in checks if not check["passed"])
    print(f"{name:>20}: {'green' if code == 0 else 'red'}  {failed}")
    return code == 0


def call(*args: object) -> int:
    """Run sfm-audit; what it prints is shown where it did not do its work."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = sfm_audit([str(arg) for arg in args])
    if code not in {0, 1}:
        sys.exit(f"sfm-audit {args[0]}: exit code {code}\n{printed.getvalue()}")
    return code


def residuals(model: pycolmap.Reconstruction, image: pycolmap.Image) -> list[tuple[pycolmap.Point2D, np.ndarray]]:
    """The image's linked 2D points, and where their 3D points project to."""
    linked = [point for point in image.points2D if point.has_point3D()]
    projected = [image.project_point(model.points3D[point.point3D_id].xyz) for point in linked]
    return [(point, xy) for point, xy in zip(linked, projected, strict=True) if xy is not None]  # None: behind it


def more_noise(model: pycolmap.Reconstruction) -> None:
    """Every residual grows by 30 %."""
    for image in model.images.values():
        for point, projected in residuals(model, image):
            point.xy = projected + 1.3 * (point.xy - projected)


def bent_lens(model: pycolmap.Reconstruction) -> None:
    """One image gets a systematic error of 0.6 px RMS that its radial parameter cannot hold: a ring."""
    image = max(model.images.values(), key=lambda each: each.num_points3D)
    centre = np.array([image.camera.width, image.camera.height]) / 2
    linked = [point for point, _ in residuals(model, image)]
    offsets = np.array([point.xy for point in linked]) - centre
    radius = np.linalg.norm(offsets, axis=1) / np.linalg.norm(centre)
    field = (np.cos(2 * np.pi * radius) / np.linalg.norm(offsets, axis=1))[:, None] * offsets
    field *= 0.6 / np.sqrt((field**2).sum(axis=1).mean())
    for point, moved in zip(linked, field, strict=True):
        point.xy = point.xy + moved


def lost_image(model: pycolmap.Reconstruction) -> None:
    """One of the photos is not registered."""
    image = min(model.images.values(), key=lambda each: each.num_points3D)
    model.deregister_frame(image.frame_id)


def other_camera(model: pycolmap.Reconstruction) -> None:
    """One camera is OPENCV with the parameters it had."""
    camera = min(model.cameras.values(), key=lambda each: each.camera_id)
    f, cx, cy, k1 = camera.params
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [f, f, cx, cy, k1, 0, 0, 0]


PLANTED: dict[str, Callable[[pycolmap.Reconstruction], None]] = {
    "sigma up by 30 %": more_noise,
    "0.6 px systematic": bent_lens,
    "an image lost": lost_image,
    "another camera model": other_camera,
}


if __name__ == "__main__":
    sys.exit(main())
