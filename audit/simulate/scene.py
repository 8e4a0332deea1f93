"""A photo collection with known truth: true cameras, points and poses, measurement noise, planted defects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sfm_audit.audit.simulate.defects import DefectSpec, PlantedDefect
from sfm_audit.audit.simulate.layout import TrackLaw, draw_tracks, place_cameras
from sfm_audit.audit.simulate.noise import NoiseSpec, draw_noise
from sfm_audit.audit.simulate.planting import plant, planted_defects, settle
from sfm_audit.audit.simulate.truth import (
    NUM_TRUE_PARAMS,
    TRUE_PARAM,
    TrueCameras,
    claimed_params_of,
    project_true,
    true_model_of,
)
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.camera_models import BY_NAME, CameraModel

_MIN_BORDER_PX: Final = 10.0


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """What to simulate.

    points_per_image: target; images get about that many observations, their sum is met.
    width, height, focal_px: px; each camera's focal length is focal_px exp(N(0, focal_spread)), its principal point the
    image centre. k1_range: of the true first radial parameter, uniform; not used by models without one.
    camera_model: the model that the reconstruction will claim: pinholes up to FULL_OPENCV, fisheyes up to
    OPENCV_FISHEYE. (FULL_OPENCV's rational terms cannot be told apart: such scenes cannot be adjusted.)
    shared_camera: one camera for all images.
    noise, defects: see NoiseSpec and DefectSpec; at most one defect per image, image_idx counts from 0.
    min_track_length, max_track_length, track_decay: P(L) ~ track_decay^L.    depths: of points in images, model units.
    unlinked_per_image: further keypoints without a point, only written to files.
    max_neighbours: nearest images that may observe a point.
    """

    num_images: int = 40
    points_per_image: int = 600
    width: int = 1600
    height: int = 1200
    focal_px: float = 1000.0
    focal_spread: float = 0.05
    k1_range: tuple[float, float] = (-0.08, 0.04)
    camera_model: str = "SIMPLE_RADIAL"
    shared_camera: bool = False
    noise: NoiseSpec = field(default_factory=NoiseSpec)
    defects: tuple[DefectSpec, ...] = ()
    min_track_length: int = 3
    max_track_length: int = 15
    track_decay: float = 0.75
    depths: tuple[float, float] = (4.0, 10.0)
    unlinked_per_image: int = 0
    max_neighbours: int = 40

    def __post_init__(self) -> None:
        true_model_of(BY_NAME[self.camera_model])
        wrong = [d.image_idx for d in self.defects if not 0 <= d.image_idx < self.num_images]
        if wrong or len({d.image_idx for d in self.defects}) < len(self.defects):
            raise ValueError(f"at most one defect per image 0..{self.num_images - 1}, got {self.defects}")
        if not 2 <= self.min_track_length <= min(self.max_track_length, self.num_images):
            raise ValueError(
                f"tracks of {self.min_track_length} to {self.max_track_length} images are not possible with "
                f"{self.num_images} images"
            )

    @property
    def claimed_model(self) -> CameraModel:
        """The camera model of the reconstruction."""
        return BY_NAME[self.camera_model]


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScene:
    """The truth and the measurements of I images, P points, M observations (by image, random order within).

    cameras: true cameras and poses, defects of lens and shutter included.
    claimed_params: (I, p) the parameters of ``spec.claimed_model`` in truth (without what it cannot express).
    image_name: length I.         camera_idx: (I,) row of the camera an image uses (all 0 if shared).
    xyz_world: (P, 3) true points, model units.
    offsets: (I + 1,) image i owns rows offsets[i]:offsets[i + 1] of the observations; image_idx: (M,).
    point_idx: (M,) rows of xyz_world.        xy_true_px, xy_px: (M, 2) without and with noise.
    sigma_px: (M,) standard deviation of the noise per axis.        defects: what was planted, by image.
    """

    spec: SceneSpec
    cameras: TrueCameras
    claimed_params: FloatArray
    image_name: tuple[str, ...]
    camera_idx: IntArray
    xyz_world: FloatArray
    offsets: IntArray
    image_idx: IntArray
    point_idx: IntArray
    xy_true_px: FloatArray
    xy_px: FloatArray
    sigma_px: FloatArray
    defects: tuple[PlantedDefect, ...]

    @property
    def sound(self) -> BoolArray:
        """(I,) images without a planted defect."""
        mask = np.ones(len(self.image_name), dtype=np.bool_)
        mask[[d.image_idx for d in self.defects]] = False
        return mask


def simulate_scene(spec: SceneSpec, rng: np.random.Generator) -> SimulatedScene:
    """Simulate a photo collection; the same spec and the same state of ``rng`` give the same scene bit for bit.

    Raises
    ------
    ValueError
        A defect of given size that the claimed camera model explains; cameras that see too little in common.
    """
    sound = _sound_cameras(spec, rng)
    planting = plant(spec.defects, spec.claimed_model, sound, spec.depths, rng)
    tracks = draw_tracks(planting.cameras, spec.points_per_image, _track_law(spec), rng)
    planting, tracks = settle(planting, tracks, spec.min_track_length, rng)
    cameras = planting.cameras
    order = np.lexsort([rng.random(len(tracks.image_idx)), tracks.image_idx])
    image_idx, point_idx = tracks.image_idx[order], tracks.point_idx[order]
    xy_true = project_true(cameras, image_idx, tracks.xyz_world[point_idx])
    noise = draw_noise(spec.noise, point_idx, rng)
    names = tuple(f"IMG_{i + 1:04d}.jpg" for i in range(spec.num_images))
    return SimulatedScene(
        spec=spec,
        cameras=cameras,
        claimed_params=claimed_params_of(spec.claimed_model, sound.params),
        image_name=names,
        camera_idx=np.zeros(spec.num_images, dtype=np.int64) if spec.shared_camera else np.arange(spec.num_images),
        xyz_world=tracks.xyz_world,
        offsets=np.searchsorted(image_idx, np.arange(spec.num_images + 1)).astype(np.int64),
        image_idx=image_idx,
        point_idx=point_idx,
        xy_true_px=xy_true,
        xy_px=xy_true + noise.xy_px,
        sigma_px=noise.sigma_px,
        defects=planted_defects(planting, tracks, names),
    )


def _sound_cameras(spec: SceneSpec, rng: np.random.Generator) -> TrueCameras:
    """Cameras that the claimed model describes exactly."""
    num_cameras = 1 if spec.shared_camera else spec.num_images
    params = np.zeros((num_cameras, NUM_TRUE_PARAMS))
    focal = spec.focal_px * np.exp(spec.focal_spread * rng.standard_normal(num_cameras))
    params[:, TRUE_PARAM["fx"]] = params[:, TRUE_PARAM["fy"]] = focal
    params[:, TRUE_PARAM["cx"]], params[:, TRUE_PARAM["cy"]] = 0.5 * spec.width, 0.5 * spec.height
    k1 = rng.uniform(*spec.k1_range, num_cameras)
    if spec.claimed_model.extra_idxs:
        params[:, TRUE_PARAM["k1"]] = k1
    rotation, translation = place_cameras(spec.num_images, rng)
    return TrueCameras(
        true_model_of(spec.claimed_model),
        spec.width,
        spec.height,
        np.broadcast_to(params, (spec.num_images, NUM_TRUE_PARAMS)).copy(),
        rotation,
        translation,
        np.zeros((spec.num_images, 6)),
    )


def _track_law(spec: SceneSpec) -> TrackLaw:
    return TrackLaw(
        spec.min_track_length,
        spec.max_track_length,
        spec.track_decay,
        spec.depths,
        max(_MIN_BORDER_PX, 8.0 * spec.noise.sigma_px),
        spec.max_neighbours,
    )
