"""Which residuals are no measurements? Feed-forward exports in float32 beside measured images; see EXACT_SHARE.

A feed-forward network (VGGT, DUSt3R, MASt3R) writes 3D points that it took out of its own depth maps in float32, one
view per point, and as 2D points the pixels that they came from: nothing was measured twice. What is left is rounding.
The script simulates such exports and, where a folder of models is given, finds the smallest largest residual of its
images. It fails where the limit does not lie between them.
"""

from __future__ import annotations

import argparse
import sys
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.table.thresholds import EXACT_SHARE, MIN_OBSERVATIONS
from sfm_audit.loaders import LoadError, discover, open_model

_ROUNDING_OF_FLOAT64: Final = 1e-12  # below it, projections written in float64


def export_residuals(rng: np.random.Generator, num_points: int = 500) -> float:
    """Return the largest residual of one simulated image, as a share of its longer side."""
    width = int(rng.choice([294, 392, 518, 1024, 2048]))
    size, focal = np.array([width, width * 3 // 4]), np.float32(width * rng.uniform(0.5, 2.0))
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix().astype(np.float32)
    translation = (rng.normal(size=3) * 10 ** rng.uniform(-1, 1)).astype(np.float32)
    xy_px = rng.integers(0, size, (num_points, 2)).astype(np.float32)
    depth = (rng.uniform(0.5, 2, num_points) * 10 ** rng.uniform(-0.5, 1)).astype(np.float32)
    centre = (size / 2).astype(np.float32)
    cam = np.column_stack([(xy_px - centre) / focal * depth[:, None], depth]).astype(np.float32)
    world = ((cam - translation) @ rotation).astype(np.float32)
    stored = Rotation.from_matrix(rotation.astype(np.float64)).as_matrix()  # a unit quaternion in float64
    again = world.astype(np.float64) @ stored.T + translation.astype(np.float64)
    projected = float(focal) * again[:, :2] / again[:, 2:] + centre
    return float(np.hypot(*(xy_px - projected).T).max() / width)


def measured_residuals(folder: str) -> list[float]:
    """Return the largest residual of each image with enough inliers, as a share of its longer side; measured ones."""
    shares: list[float] = []
    for ref in discover([folder]).refs:
        try:
            model = open_model(ref.location)
        except LoadError:
            continue
        residuals = model_residuals(model)
        length = np.hypot(*residuals.residuals_px)
        for image_idx in range(len(model.images)):
            camera, rows = model.image(image_idx).camera, residuals.rows(image_idx)
            if camera is not None and rows.stop - rows.start >= MIN_OBSERVATIONS.default:
                shares.append(float(length[rows].max() / max(camera.width, camera.height)))
    return [share for share in shares if share > _ROUNDING_OF_FLOAT64]


def main() -> int:
    """Print both distributions; exit code 1 where the limit is in one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer simulated images, no models")
    parser.add_argument("--models", metavar="FOLDER", help="models of measured photos, at or below it")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    exported = np.array([export_residuals(rng) for _ in range(200 if arguments.quick else 2000)])
    quantiles = ", ".join(f"{value:.1e}" for value in np.quantile(exported, [0.5, 0.9, 0.99, 1.0]))
    print(
        f"limit {EXACT_SHARE:.1e} of the longer side; {len(exported)} images in float32: 50, 90, 99, 100 %: {quantiles}"
    )
    below = float((exported <= EXACT_SHARE).mean())
    print(f"below the limit: {below:.1%}")
    is_right = below >= 0.99
    if arguments.models and not arguments.quick:
        measured = measured_residuals(arguments.models)
        print(f"{len(measured)} measured images: smallest {min(measured):.1e}")
        is_right &= min(measured) > EXACT_SHARE
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
