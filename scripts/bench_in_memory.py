"""What does it cost to take a reconstruction out of pycolmap's memory? Numbers of docs/performance.md.

Three ways in turns, the fastest of some rounds each: arrays (`from_pycolmap`), one Python object
per observation, and writing files and reading them again. Fails where arrays are not the fastest by the factor below.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final
from unittest import mock

import pycolmap

from sfm_audit.loaders.colmap import in_memory
from sfm_audit.loaders.opening import from_pycolmap, open_model

MIN_RATIO: Final = 3.0
"""Objects cost at least this many times what arrays cost, or the arrays are not read any more."""


def synthesized(num_images: int, num_points: int) -> pycolmap.Reconstruction:
    """Return a reconstruction whose images see most points, with as many 2D points that nothing links to."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, num_images
    options.num_points3D = num_points
    options.num_points2D_without_point3D = num_points
    return pycolmap.synthesize_dataset(options)


def by_objects(reconstruction: pycolmap.Reconstruction) -> None:
    """Take everything out by Python objects, tracks included."""
    with (
        mock.patch.object(in_memory, "_layout", return_value=None),
        mock.patch.object(in_memory, "_agree", return_value=False),
    ):
        from_pycolmap(reconstruction)


def by_files(reconstruction: pycolmap.Reconstruction) -> None:
    """Write files and read them."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        open_model(Path(folder))


def measure(reconstruction: pycolmap.Reconstruction, rounds: int) -> dict[str, float]:
    """Return the shortest time of each way, s."""
    ways: dict[str, Callable[[pycolmap.Reconstruction], object]] = {
        "arrays": from_pycolmap,
        "objects": by_objects,
        "files": by_files,
    }
    times: dict[str, float] = {}
    for _ in range(rounds):
        for name, way in ways.items():
            started = time.perf_counter()
            way(reconstruction)
            times[name] = min(times.get(name, float("inf")), time.perf_counter() - started)
    return times


def main() -> int:
    """Measure and print; exit code 1 where arrays are not faster."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small reconstruction, as in .ci/run")
    quick = parser.parse_args().quick
    reconstruction = synthesized(10, 1000) if quick else synthesized(200, 5000)
    times = measure(reconstruction, 3 if quick else 5)
    num = reconstruction.compute_num_observations()
    print(f"{reconstruction.num_reg_images()} images, {num} observations, as many 2D points without a 3D point")
    for name, seconds in times.items():
        print(f"  {name:<8} {seconds:.3f} s, {seconds / num * 1e9:.0f} ns per observation")
    ratio = times["objects"] / times["arrays"]
    print(f"objects / arrays = {ratio:.1f}, files / arrays = {times['files'] / times['arrays']:.1f}")
    return 0 if ratio >= MIN_RATIO else 1


if __name__ == "__main__":
    sys.exit(main())
