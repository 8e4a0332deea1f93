"""Planted defects: what is wrong with an image, and by how many pixels.

The size of a defect is its *systematic* RMS: what is left of the noise-free displacement after the image's own
parameters (pose and every claimed intrinsic but the principal point) were refitted with the points held at the truth.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, cast

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project, project_with_jacobians
from sfm_audit.audit.inliers.stationarity import pose_jacobian
from sfm_audit.audit.simulate.truth import TRUE_PARAM, TrueCameras, claimed_params_of, project_true, rays_of_pixels
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import CameraModel


class DefectKind(StrEnum):
    """What can be wrong with an image, and the numbers that say how (``DefectSpec.values``).

    RADIAL_K2: (k2,)             RADIAL_K3: (k3,)            TANGENTIAL: (p1, p2)        ASPECT: (fy / fx - 1,)
    PRINCIPAL_POINT: (dx, dy) px.        ROLLING_SHUTTER: rotation (3,) rad and translation (3,) from first to last row.
    PERTURBED_POSE: rotation (3,) rad and translation (3,) in the camera frame, applied after adjustment.
    FEW_POINTS: (number, corner): only so many points, all in corner 0..3 = top left, top right, bottom left, right.
    """

    RADIAL_K2 = "radial_k2"
    RADIAL_K3 = "radial_k3"
    TANGENTIAL = "tangential"
    ASPECT = "aspect"
    PRINCIPAL_POINT = "principal_point"
    ROLLING_SHUTTER = "rolling_shutter"
    PERTURBED_POSE = "perturbed_pose"
    FEW_POINTS = "few_points"


NUM_VALUES: Final = {
    DefectKind.RADIAL_K2: 1,
    DefectKind.RADIAL_K3: 1,
    DefectKind.TANGENTIAL: 2,
    DefectKind.ASPECT: 1,
    DefectKind.PRINCIPAL_POINT: 2,
    DefectKind.ROLLING_SHUTTER: 6,
    DefectKind.PERTURBED_POSE: 6,
    DefectKind.FEW_POINTS: 2,
}
CORNERS: Final = ("top left", "top right", "bottom left", "bottom right")
_FEW_POINTS: Final = 20
_GRID: Final = (24, 18)  # pixels at which the size of a defect is set, one random depth each
_MAX_SIZING_STEPS: Final = 30
_SIZING_TOLERANCE: Final = 1e-6
_ABSORBED: Final = 1e-6  # px: the claimed camera has the parameter, the defect cannot have a size
_MAX_FIT_STEPS: Final = 30
_FIT_TOLERANCE_PX: Final = 1e-10


@dataclass(frozen=True, slots=True)
class DefectSpec:
    """A defect to plant in the image ``image_idx``: of ``size_px`` systematic RMS, or with exactly these ``values``.

    With ``values`` None the direction is random. FEW_POINTS has no size; with ``values`` the size is not used.
    """

    image_idx: int
    kind: DefectKind
    size_px: float = 1.0
    values: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.values is not None and len(self.values) != NUM_VALUES[self.kind]:
            raise ValueError(f"{self.kind} takes {NUM_VALUES[self.kind]} values, got {len(self.values)}")
        if not self.size_px > 0:
            raise ValueError(f"size_px must be positive, got {self.size_px}")


@dataclass(frozen=True, slots=True)
class PlantedDefect:
    """A defect as planted. systematic_px: measured on the image's own points, None for FEW_POINTS."""

    image_idx: int
    image_name: str
    kind: DefectKind
    values: tuple[float, ...]
    systematic_px: float | None
    words: str


def with_defect(cameras: TrueCameras, image_idx: int, kind: DefectKind, values: tuple[float, ...]) -> TrueCameras:
    """Return the cameras with a defect of lens or shutter in one image; PERTURBED_POSE and FEW_POINTS change none."""
    params, shutter = cameras.params.copy(), cameras.rolling_shutter.copy()
    row = params[image_idx]
    match kind:
        case DefectKind.RADIAL_K2:
            row[TRUE_PARAM["k2"]] += values[0]
        case DefectKind.RADIAL_K3:
            row[TRUE_PARAM["k3"]] += values[0]
        case DefectKind.TANGENTIAL:
            row[[TRUE_PARAM["p1"], TRUE_PARAM["p2"]]] += values
        case DefectKind.ASPECT:
            row[TRUE_PARAM["fy"]] *= 1.0 + values[0]
        case DefectKind.PRINCIPAL_POINT:
            row[[TRUE_PARAM["cx"], TRUE_PARAM["cy"]]] += values
        case DefectKind.ROLLING_SHUTTER:
            shutter[image_idx] = values
        case DefectKind.PERTURBED_POSE | DefectKind.FEW_POINTS:
            pass
    return dataclasses.replace(cameras, params=params, rolling_shutter=shutter)


def perturbed_pose(rotation: FloatArray, translation: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a pose (3, 3), (3,) moved in the camera frame by a rotation vector (rad) and a translation (6,)."""
    turn = Rotation.from_rotvec(values[:3]).as_matrix()
    return turn @ rotation, turn @ translation + values[3:]


def displacement_px(
    kind: DefectKind, values: tuple[float, ...], cameras: TrueCameras, image_idx: int, xyz_world: FloatArray
) -> FloatArray:
    """Return (n, 2) px: by how much the defect moves the noise-free projections (n, 3) of one image."""
    where = np.full(len(xyz_world), image_idx)
    sound = project_true(cameras, where, xyz_world)
    if kind is DefectKind.PERTURBED_POSE:
        rotation, translation = perturbed_pose(
            cameras.rotation_cam_from_world[image_idx],
            cameras.translation_cam_from_world[image_idx],
            np.asarray(values),
        )
        moved = project(cameras.model, cameras.params[image_idx], xyz_world @ rotation.T + translation)
        return np.asarray(sound - moved)
    return project_true(with_defect(cameras, image_idx, kind, values), where, xyz_world) - sound


def systematic_rms_px(
    claimed: CameraModel,
    params: FloatArray,
    xyz_world: FloatArray,
    xy_px: FloatArray,
    *,
    rotation: FloatArray,
    translation: FloatArray,
) -> float:
    """Return the RMS length, px, that remains of xy - projection after refitting one image to noise-free points.

    Parameters
    ----------
    params : (p,) start; all are fitted but the principal point        rotation, translation : (3, 3), (3,) start
    xyz_world : (n, 3) held fixed        xy_px : (n, 2) noise-free

    Notes
    -----
    Gauss-Newton on pose (left perturbation) and intrinsics; method.md section 5's nuisance columns N, iterated.
    """
    free = [j for j in range(claimed.num_params) if j not in claimed.principal_point_idxs]
    params = params.copy()
    previous = math.inf
    for _ in range(_MAX_FIT_STEPS):
        xyz_cam = xyz_world @ rotation.T + translation
        projection = project_with_jacobians(claimed, params, xyz_cam)
        of_intrinsics = cast("FloatArray", projection.d_xy_d_params)[:, :, free]
        columns = np.concatenate([pose_jacobian(projection.d_xy_d_cam, xyz_cam), of_intrinsics], axis=2)
        columns = columns.reshape(2 * len(xyz_cam), -1)
        residuals = (xy_px - projection.xy_px).ravel()
        rms = float(np.sqrt(residuals @ residuals / len(xyz_cam)))
        if abs(previous - rms) < _FIT_TOLERANCE_PX:
            break
        previous = rms
        norms = np.linalg.norm(columns, axis=0)
        norms[norms == 0] = 1.0
        step = np.linalg.lstsq(columns / norms, residuals, rcond=1e-12)[0] / norms
        rotation, translation = perturbed_pose(rotation, translation, step[:6])
        params[free] += step[6:]
    return rms


def random_values(kind: DefectKind, rng: np.random.Generator) -> tuple[float, ...]:
    """Draw the direction of a defect, with a plausible magnitude that `values_of_size` then corrects."""
    sign = float(rng.choice([-1.0, 1.0]))
    angle = float(rng.uniform(0.0, 2.0 * math.pi))
    match kind:
        case DefectKind.RADIAL_K2 | DefectKind.RADIAL_K3:
            return (0.02 * sign,)
        case DefectKind.TANGENTIAL:
            return (1e-3 * math.cos(angle), 1e-3 * math.sin(angle))
        case DefectKind.ASPECT:
            return (2e-3 * sign,)
        case DefectKind.PRINCIPAL_POINT:
            return (5.0 * math.cos(angle), 5.0 * math.sin(angle))
        case DefectKind.FEW_POINTS:
            return (_FEW_POINTS, float(rng.integers(len(CORNERS))))
        case DefectKind.ROLLING_SHUTTER | DefectKind.PERTURBED_POSE:
            turn, shift = rng.standard_normal((2, 3))
            return tuple(float(v) for v in (*(2e-3 * turn), *(5e-3 * shift)))


def values_of_size(
    size_px: float,
    kind: DefectKind,
    values: tuple[float, ...],
    *,
    claimed: CameraModel,
    cameras: TrueCameras,
    image_idx: int,
    xyz_world: FloatArray,
) -> tuple[float, ...]:
    """Return ``values`` scaled so that the defect has ``size_px`` systematic RMS on the points (n, 3) of its image.

    ValueError when the claimed camera explains the defect, so that no value has that size.
    """
    for _ in range(_MAX_SIZING_STEPS):
        size = defect_size_px(kind, values, claimed=claimed, cameras=cameras, image_idx=image_idx, xyz_world=xyz_world)
        if not size > _ABSORBED:
            raise ValueError(f"{claimed.name} explains {kind} in image {image_idx}: it cannot be {size_px} px wrong")
        if abs(size / size_px - 1.0) < _SIZING_TOLERANCE:
            break
        gain = min(max(size_px / size, 0.1), 10.0)
        values = tuple(value * gain for value in values)
    return values


def defect_size_px(
    kind: DefectKind,
    values: tuple[float, ...],
    *,
    claimed: CameraModel,
    cameras: TrueCameras,
    image_idx: int,
    xyz_world: FloatArray,
) -> float:
    """Return the systematic RMS, px, of a defect on the points (n, 3) of an image whose camera is otherwise sound.

    A pose perturbed after adjustment is not refitted by anybody: its size is the RMS displacement itself.
    """
    moved = displacement_px(kind, values, cameras, image_idx, xyz_world)
    if kind is DefectKind.PERTURBED_POSE:
        return float(np.sqrt((moved**2).sum(axis=1).mean()))
    xy_px = project_true(cameras, np.full(len(xyz_world), image_idx), xyz_world) + moved
    return systematic_rms_px(
        claimed,
        claimed_params_of(claimed, cameras.params)[image_idx],
        xyz_world,
        xy_px,
        rotation=cameras.rotation_cam_from_world[image_idx],
        translation=cameras.translation_cam_from_world[image_idx],
    )


def points_all_over(
    cameras: TrueCameras, image_idx: int, depths: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Return (n, 3) world points on the rays of a grid of pixels of one image, depths uniform in model units."""
    columns, rows = (np.arange(count) + 0.5 for count in _GRID)
    x, y = np.meshgrid(columns * cameras.width / _GRID[0], rows * cameras.height / _GRID[1])
    xy_px = np.column_stack([x.ravel(), y.ravel()])
    rays = rays_of_pixels(cameras, np.full(len(xy_px), image_idx), xy_px)
    depth = rng.uniform(*depths, len(rays))
    xyz_cam = rays * depth[:, None]
    rotation, translation = cameras.rotation_cam_from_world[image_idx], cameras.translation_cam_from_world[image_idx]
    return np.asarray((xyz_cam - translation) @ rotation)[np.isfinite(rays).all(axis=1)]


def words_of(kind: DefectKind, values: tuple[float, ...], systematic_px: float | None) -> str:
    """One sentence for people: what was planted."""
    if kind is DefectKind.FEW_POINTS:
        return f"only {values[0]:.0f} points, all in the {CORNERS[int(values[1])]} corner"
    match kind:
        case DefectKind.RADIAL_K2:
            what = f"the lens has k2 = {values[0]:+.4f}"
        case DefectKind.RADIAL_K3:
            what = f"the lens has k3 = {values[0]:+.4f}"
        case DefectKind.TANGENTIAL:
            what = f"the lens has p1, p2 = {values[0]:+.5f}, {values[1]:+.5f}"
        case DefectKind.ASPECT:
            what = f"fy / fx = {1 + values[0]:.5f}"
        case DefectKind.PRINCIPAL_POINT:
            what = f"the optical centre is off by ({values[0]:+.1f}, {values[1]:+.1f}) px"
        case DefectKind.ROLLING_SHUTTER:
            what = "the camera moved while it was read out"
        case DefectKind.PERTURBED_POSE:
            return f"the pose was moved by {systematic_px:.2f} px RMS after adjustment"
    return f"{what}, {systematic_px:.2f} px RMS systematic"
