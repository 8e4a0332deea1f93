"""What a reconstruction of the scene would claim: bundle adjustment with pycolmap, defects of a later hand, files."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.defects import DefectKind, perturbed_pose
from sfm_audit.audit.simulate.scene import SimulatedScene
from sfm_audit.audit.simulate.truth import cam_from_world, project_claimed
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.colmap.formats import BINARY
from sfm_audit.loaders.model import (
    CameraTable,
    ImageTable,
    ObservationTable,
    PointTable,
    SparseModel,
    rotation_from_quat,
)

_GRADIENT_TOLERANCE: Final = 1e-4  # of the cost in px^2 per unit of each parameter: pose offsets end below 1e-5 px
_MAX_ITERATIONS: Final = 200


class AdjustmentError(RuntimeError):
    """Bundle adjustment did not reach its optimum."""


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What a reconstruction says about a scene; row i of every array is image i.

    params: (I, p) of the claimed camera model (equal rows if shared).
    quat_cam_from_world_wxyz: (I, 4) unit.    translation_cam_from_world: (I, 3) model units.
    xyz_world: (P, 3).
    """

    params: FloatArray
    quat_cam_from_world_wxyz: FloatArray
    translation_cam_from_world: FloatArray
    xyz_world: FloatArray


def true_claim(scene: SimulatedScene) -> Claim:
    """Return what a reconstruction would claim that knows the truth, as far as its camera model can express it."""
    return Claim(
        scene.claimed_params,
        _quat_wxyz(scene.cameras.rotation_cam_from_world),
        scene.cameras.translation_cam_from_world,
        scene.xyz_world,
    )


def adjust_scene(scene: SimulatedScene, *, num_threads: int = 1, start: Claim | None = None) -> Claim:
    """Bundle-adjust a scene as COLMAP does, then perturb the poses that a defect says were touched afterwards.

    Parameters
    ----------
    scene : observed points and tracks are taken from it
    start : where the adjustment starts; the truth by default

    Returns
    -------
    Claim
        The optimum of the plain least-squares cost over poses, points and all intrinsics but the principal point, in
        the gauge of the first two cameras of ``start``, and with post-adjustment defects applied.

    Raises
    ------
    AdjustmentError
        The solver did not reach the optimum.
    """
    with tempfile.TemporaryDirectory() as folder:
        model = sparse_model(scene, true_claim(scene) if start is None else start)
        write_colmap_binary(model, Path(folder), np.random.default_rng(0))
        reconstruction = pycolmap.Reconstruction(folder)
    _solve(reconstruction, num_threads)
    return _perturbed(scene, _claim_of(scene, reconstruction))


def sparse_model(scene: SimulatedScene, claim: Claim, location: str = "simulated") -> SparseModel:
    """Return the reconstruction as the columnar model that a loader would read from its files.

    Ids count from 1. Stored point errors are the mean reprojection errors of ``claim``, as COLMAP defines them. Linked
    keypoints come first, in the order of the scene, then ``spec.unlinked_per_image`` others.
    """
    spec, num_images = scene.spec, len(scene.image_name)
    num_cameras = 1 if spec.shared_camera else num_images
    num_params = spec.claimed_model.num_params
    camera_id = np.arange(1, num_cameras + 1, dtype=np.uint32)
    return SparseModel(
        location=location,
        file_format=BINARY.name,
        cameras=CameraTable(
            camera_id,
            np.full(num_cameras, spec.claimed_model.model_id, dtype=np.int64),
            np.full(num_cameras, spec.width, dtype=np.int64),
            np.full(num_cameras, spec.height, dtype=np.int64),
            claim.params[:num_cameras].ravel(),
            np.arange(num_cameras + 1, dtype=np.int64) * num_params,
        ),
        images=ImageTable(
            np.arange(1, num_images + 1, dtype=np.uint32),
            scene.image_name,
            camera_id[scene.camera_idx],
            scene.camera_idx,
            claim.quat_cam_from_world_wxyz,
            claim.translation_cam_from_world,
            np.diff(scene.offsets) + spec.unlinked_per_image,
        ),
        points=PointTable(
            np.arange(1, len(claim.xyz_world) + 1, dtype=np.uint64), claim.xyz_world, _point_errors_px(scene, claim)
        ),
        observations=ObservationTable(
            scene.offsets,
            (np.arange(len(scene.point_idx)) - scene.offsets[scene.image_idx]).astype(np.uint32),
            scene.xy_px,
            scene.point_idx.astype(np.int32),
        ),
        findings=(),
    )


def residuals_px(scene: SimulatedScene, claim: Claim) -> FloatArray:
    """Return (M, 2) px: observed minus projected by the claim."""
    rotation = rotation_from_quat(claim.quat_cam_from_world_wxyz)
    xyz_cam = cam_from_world(
        rotation, claim.translation_cam_from_world, scene.image_idx, claim.xyz_world[scene.point_idx]
    )
    return scene.xy_px - project_claimed(scene.spec.claimed_model, claim.params, scene.image_idx, xyz_cam)


def write_model(scene: SimulatedScene, claim: Claim, folder: Path, *, text: bool = False) -> None:
    """Write the reconstruction into a folder as COLMAP's .bin files, or as .txt files written by pycolmap.

    Keypoints without a point are placed by a generator seeded with their number: the same scene, the same bytes.
    """
    rng = np.random.default_rng(scene.spec.unlinked_per_image)
    model = sparse_model(scene, claim)
    if not text:
        write_colmap_binary(model, folder, rng)
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as binary:
        write_colmap_binary(model, Path(binary), rng)
        pycolmap.Reconstruction(binary).write_text(str(folder))


def write_adjusted_model(scene: SimulatedScene, folder: Path, *, num_threads: int = 1, text: bool = False) -> Claim:
    """Bundle-adjust a scene, write the reconstruction into a folder, return what it claims."""
    claim = adjust_scene(scene, num_threads=num_threads)
    write_model(scene, claim, folder, text=text)
    return claim


def _solve(reconstruction: pycolmap.Reconstruction, num_threads: int) -> None:
    """Adjust in place; AdjustmentError unless the solver says that it converged."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = False
    solver = options.ceres.solver_options
    solver.num_threads = num_threads
    solver.max_num_iterations = _MAX_ITERATIONS
    solver.function_tolerance = solver.parameter_tolerance = 0.0
    solver.gradient_tolerance = _GRADIENT_TOLERANCE
    summary = pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    if summary.termination_type != pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
        raise AdjustmentError(f"bundle adjustment did not converge: {summary.brief_report()}")


def _claim_of(scene: SimulatedScene, reconstruction: pycolmap.Reconstruction) -> Claim:
    """The adjusted values, in the scene's order."""
    images = [reconstruction.images[i + 1] for i in range(len(scene.image_name))]
    poses = [image.cam_from_world() for image in images]
    points = reconstruction.points3D
    return Claim(
        np.array([reconstruction.cameras[image.camera_id].params for image in images]),
        np.array([pose.rotation.quat for pose in poses])[:, [3, 0, 1, 2]],
        np.array([pose.translation for pose in poses]),
        np.array([points[j + 1].xyz for j in range(len(scene.xyz_world))]),
    )


def _perturbed(scene: SimulatedScene, claim: Claim) -> Claim:
    """The claim after somebody moved the poses that PERTURBED_POSE names."""
    quat, translation = claim.quat_cam_from_world_wxyz.copy(), claim.translation_cam_from_world.copy()
    for defect in scene.defects:
        if defect.kind is DefectKind.PERTURBED_POSE:
            i = defect.image_idx
            rotation, translation[i] = perturbed_pose(
                rotation_from_quat(quat[i]), translation[i], np.asarray(defect.values)
            )
            quat[i] = _quat_wxyz(rotation)
    return Claim(claim.params, quat, translation, claim.xyz_world)


def _point_errors_px(scene: SimulatedScene, claim: Claim) -> FloatArray:
    """(P,) mean reprojection error of each point's track, px."""
    lengths = np.linalg.norm(residuals_px(scene, claim), axis=1)
    num_points = len(claim.xyz_world)
    sums = np.bincount(scene.point_idx, weights=lengths, minlength=num_points)
    return np.asarray(sums / np.bincount(scene.point_idx, minlength=num_points))


def _quat_wxyz(rotation: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions w x y z of rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True)[..., [3, 0, 1, 2]])
