"""Write one MegaDepth-shaped model with known truth, for benchmarks: python scripts/simulate_large_model.py FOLDER.

No bundle adjustment: points, poses and cameras are the truth, residuals are the noise itself.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from sfm_audit.audit.simulate.adjust import true_claim, write_model
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

_TRACK_DECAY = 0.70  # mean track length 5, as 2 M observations of 400,000 points


def main() -> None:
    """Parse arguments, simulate, write, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--observations", type=int, default=2000, help="linked keypoints per image")
    parser.add_argument("--keypoints", type=int, default=8000, help="keypoints per image, linked or not")
    parser.add_argument("--sigma", type=float, default=0.5, help="px per axis, one lognormal value per track")
    parser.add_argument("--shared", action="store_true", help="one camera for all images")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    spec = SceneSpec(
        num_images=args.images,
        points_per_image=args.observations,
        shared_camera=args.shared,
        unlinked_per_image=max(0, args.keypoints - args.observations),
        noise=NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=args.sigma),
        track_decay=_TRACK_DECAY,
        max_neighbours=24,
    )
    start = time.perf_counter()
    scene = simulate_scene(spec, np.random.default_rng(args.seed))
    simulated = time.perf_counter()
    write_model(scene, true_claim(scene), args.folder)
    written = time.perf_counter()
    size_mb = sum(path.stat().st_size for path in args.folder.glob("*.bin")) / 1e6
    print(
        f"{args.folder}: {args.images} images, {len(scene.xyz_world)} points, {len(scene.point_idx)} observations, "
        f"{size_mb:.0f} MB; simulated in {simulated - start:.1f} s, written in {written - simulated:.1f} s"
    )


if __name__ == "__main__":
    main()
