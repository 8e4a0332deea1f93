"""Are the standard deviations of poses right? Against the truth of simulated scenes.

    .venv/bin/python scripts/study_poses.py              40 scenes of each kind of noise
    .venv/bin/python scripts/study_poses.py --quick      a few; fails when a ratio leaves its band

Scenes with known cameras are observed with noise and bundle-adjusted; poses, points and all intrinsics but the
principal point are free, as for the mapper. The errors of the poses, without the similarity that fits all of them best,
are divided by their standard deviations from ``run --covariance``: the mean square is 1 where these are right.
"Together": e^T C^-1 e / 6 over rotation and centre, correlations included. "Relative": of the strongest neighbour, seen
from the image. "Within 2 sd": share of rotations whose angle is within two of its standard deviations.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.joint import JointSystem, PoseCovariance, joint_system, pose_covariances, pose_gauge
from sfm_audit.audit.joint.layout import NUM_POSE
from sfm_audit.audit.simulate.adjust import Claim, adjust_scene, sparse_model
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, SimulatedScene, simulate_scene
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import rotation_from_quat

KINDS: Final = (NoiseKind.GAUSSIAN, NoiseKind.PER_TRACK_LOGNORMAL, NoiseKind.LAPLACE)
BAND: Final = (0.8, 1.5)
"""Of the mean squares with --quick: thirty scenes of 12 images, whose errors are correlated."""


@dataclass(frozen=True, slots=True)
class Ratios:
    """Errors of one image over their standard deviations, squared; and whether its turn is within two of them."""

    rotation: float
    centre: float
    together: float
    rotation_rel: float
    centre_rel: float
    within: bool


def main() -> int:
    """Simulate, adjust, compare, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=int, default=40, help="of each kind of noise")
    args = parser.parse_args()
    num_scenes = 10 if args.quick else args.scenes
    print("| noise | images | rotation | centre | together | relative rotation | relative centre | within 2 sd |")
    print("|---|---|---|---|---|---|---|---|")
    found: list[Ratios] = []
    for kind in KINDS:
        of_kind = [each for seed in range(num_scenes) for each in ratios(kind, seed)]
        found += of_kind
        print(_row(kind.value, of_kind), flush=True)
    means = [np.mean([getattr(each, name) for each in found]) for name in _SQUARES]
    if args.quick and not all(BAND[0] < mean < BAND[1] for mean in means):
        print(f"a mean square is outside of {BAND}")
        return 1
    return 0


_SQUARES: Final = ("rotation", "centre", "together", "rotation_rel", "centre_rel")


def _row(name: str, found: list[Ratios]) -> str:
    cells = [f"{np.mean([getattr(each, square) for each in found]):.2f}" for square in _SQUARES]
    within = np.mean([each.within for each in found])
    return f"| {name} | {len(found)} | {' | '.join(cells)} | {within:.1%} |"


def ratios(kind: NoiseKind, seed: int) -> Iterator[Ratios]:
    """Yield what the images of one scene say."""
    noise = NoiseSpec(kind, sigma_px=0.5)
    spec = SceneSpec(num_images=12, points_per_image=500, noise=noise, shared_camera=seed % 2 == 0)
    scene = simulate_scene(spec, np.random.default_rng(4000 + seed))
    claim = adjust_scene(scene)
    model = sparse_model(scene, claim)
    system = joint_system(model, model_residuals(model), ModelAuditor(model).sigma_constant_px)
    images = list(range(len(model.images)))
    known = pose_covariances(system, images, system.image_covariances(images))
    errors = pose_errors(system, scene, claim)
    for image, pose in zip(images, known, strict=True):
        yield _ratios_of(system, image, pose, errors)


def pose_errors(system: JointSystem, scene: SimulatedScene, claim: Claim) -> FloatArray:
    """(D,) errors of all poses as left perturbations of the truth, in the gauge of `pose_gauge`."""
    layout = system.observations.layout
    out = np.zeros(layout.num_columns)
    rotation = rotation_from_quat(claim.quat_cam_from_world_wxyz)
    for image in range(len(rotation)):
        turn = Rotation.from_matrix(rotation[image] @ scene.cameras.rotation_cam_from_world[image].T)
        moved = claim.translation_cam_from_world[image] - turn.apply(scene.cameras.translation_cam_from_world[image])
        out[layout.pose_of_image(image)] = np.concatenate([turn.as_rotvec(), moved])
    return pose_gauge(system).removed(out)


def _ratios_of(system: JointSystem, image: int, pose: PoseCovariance, errors: FloatArray) -> Ratios:
    layout, model = system.observations.layout, system.model
    depth = system.median_depth(image)
    own = errors[layout.pose_of_image(image)] * np.repeat([1.0, -1.0 / depth], 3)
    covariance = pose.covariance[:NUM_POSE, :NUM_POSE]
    other = pose.neighbour_idx
    if other is None:
        raise ValueError("every image of these scenes has neighbours")
    beside = errors[layout.pose_of_image(other)]
    first, second = model.image(image), model.image(other)
    turn = second.rotation_cam_from_world @ first.rotation_cam_from_world.T
    centre = first.translation_cam_from_world - turn.T @ second.translation_cam_from_world
    mine = errors[layout.pose_of_image(image)]
    turned = beside[:3] - turn @ mine[:3]
    moved = (np.cross(mine[:3], centre) + mine[3:] - turn.T @ beside[3:]) / depth
    return Ratios(
        float(own[:3] @ own[:3] / np.trace(covariance[:3, :3])),
        float(own[3:] @ own[3:] / np.trace(covariance[3:, 3:])),
        float(own @ np.linalg.solve(covariance, own)) / NUM_POSE,
        float(turned @ turned / np.trace(pose.relative[:3, :3])),
        float(moved @ moved / np.trace(pose.relative[3:, 3:])),
        bool(np.degrees(np.linalg.norm(own[:3])) <= 2 * pose.sd_rotation_deg),
    )


if __name__ == "__main__":
    sys.exit(main())
