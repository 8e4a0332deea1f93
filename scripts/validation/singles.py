"""Single images with independent 3D points: pose, focal length and k1 are fitted to them, then the image is audited."""

from __future__ import annotations

import numpy as np
import pandas as pd

from scripts.validation.truth import SIGMA_PX, noise_of
from sfm_audit.audit.cameras import project, project_with_jacobians, unproject
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.image import ImageAudit, audit_inliers
from sfm_audit.audit.inliers.stationarity import pose_jacobian
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.simulate.defects import (
    DefectKind,
    defect_size_px,
    perturbed_pose,
    random_values,
    values_of_size,
    with_defect,
)
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec, draw_noise
from sfm_audit.audit.simulate.truth import TrueCameras, claimed_params_of, project_true, true_model_of
from sfm_audit.audit.table.words import POLICIES, Member
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord, InlierSet

WIDTH, HEIGHT, FOCAL, K1 = 1600, 1200, 1000.0, -0.05
DEPTHS = (4.0, 10.0)
CLAIMED = BY_NAME["SIMPLE_RADIAL"]
CONFIG = AuditConfig(noise="constant", points="independent")
NORMALITY = ("ks", "ks_fitted", "ks_norm", "dap", "sw")
EXACT_DEFECTS = {DefectKind.RADIAL_K2: (0.05,), DefectKind.TANGENTIAL: (1e-3, 1e-3)}
_SEED_SIZE, _SEED_POWER, _SEED_EXACT = 1, 2, 3
_MAX_STEPS, _STEP_TOLERANCE_PX = 20, 1e-7
MEMBERS = {
    "ks": Member.KS,
    "misfit": Member.MISFIT,
    "pose": Member.POSE,
    "plausible": Member.PLAUSIBLE,
    "noise": Member.NOISE,
}


def sound_camera() -> TrueCameras:
    """One image at the origin, as SIMPLE_RADIAL describes it."""
    params = np.zeros((1, 12))
    params[0, :5] = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, K1
    eye, zero = np.eye(3)[None], np.zeros((1, 3))
    return TrueCameras(true_model_of(CLAIMED), WIDTH, HEIGHT, params, eye, zero, np.zeros((1, 6)))


def draw_points(n: int, rng: np.random.Generator) -> FloatArray:
    """Return (n, 3): uniform over the image, depth uniform."""
    camera = sound_camera()
    rays = unproject(camera.model, camera.params[0], rng.random((n, 2)) * (WIDTH, HEIGHT))
    return np.asarray(rays / rays[:, 2:] * rng.uniform(*DEPTHS, n)[:, None])


def fit_image(xyz: FloatArray, xy_px: FloatArray) -> tuple[CameraRecord, FloatArray]:
    """Return camera and points in its frame after least squares over pose, f and k1 (Gauss-Newton from the truth)."""
    params = claimed_params_of(CLAIMED, sound_camera().params)[0].copy()
    free = [i for i in range(CLAIMED.num_params) if i not in CLAIMED.principal_point_idxs]
    rotation, translation = np.eye(3), np.zeros(3)
    for _ in range(_MAX_STEPS):
        xyz_cam = xyz @ rotation.T + translation
        found = project_with_jacobians(CLAIMED, params, xyz_cam)
        of_params = np.asarray(found.d_xy_d_params)[:, :, free]
        columns = np.concatenate([pose_jacobian(found.d_xy_d_cam, xyz_cam), of_params], axis=2).reshape(
            2 * len(xyz), -1
        )
        norms = np.linalg.norm(columns, axis=0)
        columns /= norms
        scaled = np.linalg.solve(columns.T @ columns, columns.T @ (xy_px - found.xy_px).ravel())
        rotation, translation = perturbed_pose(rotation, translation, (scaled / norms)[:6])
        params[free] += (scaled / norms)[6:]
        if np.linalg.norm(columns @ scaled) < _STEP_TOLERANCE_PX * np.sqrt(len(xyz)):
            break
    return CameraRecord(1, CLAIMED, WIDTH, HEIGHT, params), xyz @ rotation.T + translation


def audit_points(xyz: FloatArray, xy_px: FloatArray) -> ImageAudit:
    """Fit the image to its points and audit it."""
    camera, xyz_cam = fit_image(xyz, xy_px)
    image = ImageRecord(1, "image", 1, camera, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), len(xyz))
    return audit_inliers(InlierSet(image, xy_px, xyz_cam, np.arange(len(xyz))), CONFIG)


def row_of(audit: ImageAudit) -> dict[str, object]:
    """What the study keeps of one image."""
    if audit.quality is None or audit.misfit is None:
        raise ValueError("an image without inliers")
    row: dict[str, object] = {f"{name}_p": getattr(audit.tests, f"{name}_p") for name in NORMALITY}
    for group in GROUPS:
        row[f"misfit_{group}_p"], row[f"misfit_{group}_px"] = audit.quality.misfit[group][:2]
    row["misfit_group"] = audit.misfit.group
    for name, member in MEMBERS.items():
        row[f"verdict_{name}"] = str(audit.decision.of(member))
    for policy in POLICIES:
        row[f"policy_{policy}"] = str(audit.decision.under(policy).verdict)
    return row


def size_trials(noise: NoiseKind, n: int, first: int, last: int, seed: int) -> pd.DataFrame:
    """Correct cameras: trials ``first`` to ``last`` of a cell.

    A single image has no tracks, so per-track noise is per-observation noise; here it gets the demo's larger spread.
    """
    spec = noise_of(noise)
    if noise is NoiseKind.PER_TRACK_LOGNORMAL:
        spec = NoiseSpec(noise, SIGMA_PX, log_spread=0.75)
    rows = []
    for trial in range(first, last):
        rng = np.random.default_rng([seed, _SEED_SIZE, list(NoiseKind).index(noise), n, trial])
        xyz = draw_points(n, rng)
        xy_px = project(CLAIMED, claimed_params_of(CLAIMED, sound_camera().params)[0], xyz)
        xy_px = xy_px + draw_noise(spec, np.arange(n), rng).xy_px
        rows.append({"noise": str(noise), "n": n, **row_of(audit_points(xyz, xy_px))})
    return pd.DataFrame(rows)


def power_trials(kind: DefectKind, n: int, first: int, last: int, seed: int) -> pd.DataFrame:
    """Defects of random direction, systematic RMS log-uniform in 0.03 .. 1.2 px, Gaussian noise."""
    rows = []
    for trial in range(first, last):
        rng = np.random.default_rng([seed, _SEED_POWER, list(DefectKind).index(kind), n, trial])
        xyz, camera = draw_points(n, rng), sound_camera()
        size = float(np.exp(rng.uniform(np.log(0.03), np.log(1.2))))
        values = values_of_size(
            size, kind, random_values(kind, rng), claimed=CLAIMED, cameras=camera, image_idx=0, xyz_world=xyz
        )
        rows.append({"kind": str(kind), "n": n, "true_px": size, **row_of(_defective(kind, values, xyz, rng))})
    return pd.DataFrame(rows)


def exact_trials(kind: DefectKind, first: int, last: int, seed: int, n: int = 250) -> pd.DataFrame:
    """The two defects of stated size: k2 = 0.05, and p1 = p2 = 1e-3; Gaussian noise."""
    rows = []
    for trial in range(first, last):
        rng = np.random.default_rng([seed, _SEED_EXACT, list(DefectKind).index(kind), n, trial])
        xyz, values = draw_points(n, rng), EXACT_DEFECTS[kind]
        size = defect_size_px(kind, values, claimed=CLAIMED, cameras=sound_camera(), image_idx=0, xyz_world=xyz)
        rows.append({"kind": str(kind), "n": n, "true_px": size, **row_of(_defective(kind, values, xyz, rng))})
    return pd.DataFrame(rows)


def _defective(kind: DefectKind, values: tuple[float, ...], xyz: FloatArray, rng: np.random.Generator) -> ImageAudit:
    """Audit an image with a defect."""
    cameras = with_defect(sound_camera(), 0, kind, values)
    xy_px = project_true(cameras, np.zeros(len(xyz), dtype=np.int64), xyz)
    return audit_points(xyz, xy_px + draw_noise(noise_of(NoiseKind.GAUSSIAN), np.arange(len(xyz)), rng).xy_px)
