"""A data set shaped like MegaDepth_v1_SfM, of any size, with known truth: for benchmarks and tests of scale.

Instead of a bundle adjustment, a few sweeps of resection and triangulation start from the truth: poses and points are
then as good as at their optimum, in seconds instead of hours.
"""

from __future__ import annotations

import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project_with_jacobians
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.inliers.stationarity import pose_jacobian
from sfm_audit.audit.noise.tracks import inverse_information, sum_by_point, symmetric_times
from sfm_audit.audit.simulate.adjust import Claim, sparse_model, true_claim, write_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec, perturbed_pose
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, SimulatedScene, simulate_scene
from sfm_audit.loaders.arrays import FloatArray

_TRACK_DECAY: Final = 0.70  # mean track length 5
_MIN_IMAGES: Final = 8
_DEFECT_PX: Final = (0.3, 1.5)  # systematic RMS, log-uniform
_SWEEPS: Final = 3


@dataclass(frozen=True, slots=True)
class DatasetSpec:
    """A data set of ``scenes`` scenes, one component each, SIMPLE_RADIAL, one camera per image.

    images: per scene, on average.      spread: standard deviation of ln(images per scene).
    linked: range of the scenes' mean number of keypoints with a 3D point, of ``keypoints`` in an image.
    defects: share of images whose lens bends more than its model.        sigma_px: noise per axis, one per track.
    """

    scenes: int
    images: int
    spread: float = 0.0
    linked: tuple[int, int] = (1500, 2500)
    keypoints: int = 8000
    defects: float = 0.02
    sigma_px: float = 0.5
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Written:
    """What was written."""

    num_scenes: int
    num_images: int
    num_observations: int
    num_bytes: int


def scene_folder(root: Path, scene: int) -> Path:
    """Return where the model of a scene lies."""
    return root / f"{scene:04d}" / "sparse" / "manhattan" / "0"


def write_dataset(root: Path, spec: DatasetSpec, jobs: int) -> Written:
    """Write all scenes, in ``jobs`` processes."""
    with ProcessPoolExecutor(jobs) as pool:
        counts = list(pool.map(_write_scene, *zip(*((root, spec, i) for i in range(spec.scenes)), strict=True)))
    num_bytes = sum(file.stat().st_size for i in range(spec.scenes) for file in scene_folder(root, i).glob("*.bin"))
    return Written(spec.scenes, sum(count[0] for count in counts), sum(count[1] for count in counts), num_bytes)


def _write_scene(root: Path, spec: DatasetSpec, scene: int) -> tuple[int, int]:
    rng = np.random.default_rng([spec.seed, scene])
    size = spec.images * math.exp(spec.spread * rng.standard_normal() - 0.5 * spec.spread**2)
    num_images = max(_MIN_IMAGES, round(size)) if spec.spread else spec.images
    linked = int(rng.integers(spec.linked[0], spec.linked[1] + 1))
    wrong = rng.choice(num_images, size=round(spec.defects * num_images), replace=False).tolist()
    sizes = np.exp(rng.uniform(math.log(_DEFECT_PX[0]), math.log(_DEFECT_PX[1]), len(wrong))).tolist()
    simulated = simulate_scene(
        SceneSpec(
            num_images=num_images,
            points_per_image=linked,
            unlinked_per_image=max(0, spec.keypoints - linked),
            noise=NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=spec.sigma_px),
            defects=tuple(DefectSpec(i, DefectKind.RADIAL_K2, px) for i, px in zip(wrong, sizes, strict=True)),
            track_decay=_TRACK_DECAY,
            max_track_length=min(15, num_images),
            max_neighbours=24,
        ),
        rng,
    )
    claim = true_claim(simulated)
    for _ in range(_SWEEPS):
        claim = _triangulated(simulated, _resected(simulated, claim))
    write_model(simulated, claim, scene_folder(root, scene))
    return num_images, len(simulated.point_idx)


def _resected(scene: SimulatedScene, claim: Claim) -> Claim:
    """One Gauss-Newton step of each image's pose, focal length and k1; points are held."""
    model = sparse_model(scene, claim)
    camera_model = scene.spec.claimed_model
    free = [*camera_model.focal_idxs, *camera_model.extra_idxs]
    params, rotation, translation = claim.params.copy(), [], claim.translation_cam_from_world.copy()
    for i in range(len(scene.image_name)):
        rows = slice(*scene.offsets[i : i + 2])
        image = model.image(i)
        xyz_cam = image.cam_from_world(claim.xyz_world[scene.point_idx[rows]])
        projection = project_with_jacobians(camera_model, claim.params[i], xyz_cam)
        of_pose = pose_jacobian(projection.d_xy_d_cam, xyz_cam)
        of_intrinsics = cast("FloatArray", projection.d_xy_d_params)[:, :, free]
        columns = np.concatenate([of_pose, of_intrinsics], axis=2).reshape(2 * len(xyz_cam), -1)
        norms = np.linalg.norm(columns, axis=0)
        columns /= norms
        gradient = columns.T @ (scene.xy_px[rows] - projection.xy_px).ravel()
        step = np.linalg.solve(columns.T @ columns, gradient) / norms
        turned, translation[i] = perturbed_pose(image.rotation_cam_from_world, translation[i], step[:6])
        rotation.append(turned)
        params[i, free] += step[6:]
    quat = Rotation.from_matrix(np.array(rotation)).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return Claim(params, quat, translation, claim.xyz_world)


def _triangulated(scene: SimulatedScene, claim: Claim) -> Claim:
    """One Gauss-Newton step of each point; cameras are held."""
    residuals = model_residuals(sparse_model(scene, claim))
    num_points = len(claim.xyz_world)
    inverse, _ = inverse_information(residuals.point_jacobian, residuals.point_idx, num_points)
    product = (residuals.point_jacobian * residuals.residuals_px[:, None]).sum(axis=0)
    gradient = np.stack([sum_by_point(product[axis], residuals.point_idx, num_points) for axis in range(3)])
    xyz_world = claim.xyz_world + symmetric_times(inverse, gradient).T
    return Claim(claim.params, claim.quat_cam_from_world_wxyz, claim.translation_cam_from_world, xyz_world)
