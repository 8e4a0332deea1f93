"""Write a data set shaped like MegaDepth_v1_SfM with known truth: python scripts/simulate_dataset.py ROOT.

ROOT/<scene>/sparse/manhattan/0, SIMPLE_RADIAL, one camera per image, 8000 keypoints per image of which 1500 to 2500
belong to 3D points; a share of the images has a lens that bends more than its model. Instead of a bundle adjustment, a
few sweeps of resection and triangulation start from the truth: poses and points are then as good as at their optimum,
in seconds instead of hours. The same arguments write the same bytes.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from sfm_audit.audit.simulate.dataset import DatasetSpec, write_dataset


def main() -> None:
    """Parse arguments, write, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--images", type=int, default=500, help="per scene, on average")
    parser.add_argument("--spread", type=float, default=0.0, help="standard deviation of ln(images per scene)")
    parser.add_argument("--linked", type=int, nargs=2, default=(1500, 2500), help="linked keypoints of an image")
    parser.add_argument("--keypoints", type=int, default=8000, help="keypoints of an image, linked or not")
    parser.add_argument("--defects", type=float, default=0.02, help="share of images with a planted lens defect")
    parser.add_argument("--sigma", type=float, default=0.5, help="px per axis, one lognormal value per track")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    spec = DatasetSpec(
        args.scenes,
        args.images,
        args.spread,
        (args.linked[0], args.linked[1]),
        args.keypoints,
        args.defects,
        args.sigma,
        args.seed,
    )
    start = time.perf_counter()
    written = write_dataset(args.root, spec, args.jobs)
    print(
        f"{args.root}: {written.num_scenes} scenes, {written.num_images} images, {written.num_observations} "
        f"observations, {written.num_bytes / 1e9:.2f} GB in {time.perf_counter() - start:.0f} s"
    )


if __name__ == "__main__":
    main()
