"""The paper's simulation: a checkerboard that comes closer, seen by a known camera and scanned from the same place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.camera_quality.coverage import coverage
from sfm_audit.audit.simulate.board_pose import BoardPose
from sfm_audit.audit.simulate.lidar_scan import LidarSpec, scan
from sfm_audit.loaders.arrays import FloatArray, UInt8Array
from sfm_audit.loaders.correspondences.records import Correspondences

BORDER_PX: Final = 8.0  # corners stay that far inside
_HALF_WIDTH: Final = 0.5  # of the corners' square: the unit of the world is its width
_BACK: Final = 1.01  # factor of the distance by which a board that leaves the image is pushed back
_FARTHEST: Final = 100.0  # times the distance that was asked for


@dataclass(frozen=True, slots=True)
class BoardSpec:
    """The simulation of the paper's section 4.1 (method.md section 9).

    num_corners: saddle points per row and column, of (num_corners + 1)^2 squares.
    focal_px, coefficients: of the true camera, centre in the middle, distortion forward: k1, k2, k3.
    width, height: px.          max_tilt_deg: the board's rotations about x, y and z are uniform in +- that.
    num_sets: boards; their half-width / image half-width on the undistorted image runs from min_extent to max_extent.
    detector_sd_px: noise of a corner, px, per axis, where nothing is rendered.
    lidar_sd_px: size in the middle of the image of the lidar's noise in pan, px; lidar_vertical_share: in tilt, of it.
    """

    num_corners: int = 15
    focal_px: float = 800.0
    coefficients: tuple[float, float, float] = (-0.0684, 0.0100, 0.0006)
    width: int = 1600
    height: int = 1600
    max_tilt_deg: float = 15.0
    num_sets: int = 56
    min_extent: float = 0.12
    max_extent: float = 0.97
    detector_sd_px: float = 0.03
    lidar_sd_px: float = 0.03
    lidar_vertical_share: float = 0.1

    def __post_init__(self) -> None:
        if self.num_corners < 2 or self.num_sets < 1:
            raise ValueError(f"need 2 corners a row and 1 set, got {self.num_corners} and {self.num_sets}")
        if not 0.0 < self.min_extent <= self.max_extent:
            raise ValueError(f"extents must be positive and rise, got {self.min_extent} to {self.max_extent}")

    @property
    def camera(self) -> CalibratedCamera:
        """The true camera."""
        return CalibratedCamera(
            self.width,
            self.height,
            Distortion.FORWARD,
            (self.focal_px, self.focal_px),
            (0.5 * self.width, 0.5 * self.height),
            np.array(self.coefficients),
            ("f", "k1", "k2", "k3"),
        )

    @property
    def lidar(self) -> LidarSpec:
        """The scanner: a step is one standard deviation of the noise, so the true sigma_l of (1) is 1 step."""
        pan_rad = self.lidar_sd_px / self.focal_px
        return LidarSpec(pan_rad, pan_rad * self.lidar_vertical_share, sd_steps=1.0)

    @property
    def xyz_world(self) -> FloatArray:
        """(num_corners^2, 3) saddle points, row by row, z = 0, around the origin; their square is 1 wide."""
        along = np.linspace(-_HALF_WIDTH, _HALF_WIDTH, self.num_corners)
        x, y = np.meshgrid(along, along)
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@dataclass(frozen=True, slots=True, eq=False)
class BoardSet:
    """One board: what was measured, and the truth. n corners; the world is the board, its unit the corners' width.

    correspondences: corners as detected, points as the lidar has them, and their neighbours in the scan.
    rotation_cam_from_world: (3, 3).    translation_cam_from_world: (3,).
    true_xy_px: (n, 2).                 true_xyz_world: (n, 3).
    coverage: hull of the detected corners / image.       extent: half-width / image half-width, without distortion.
    """

    correspondences: Correspondences
    true_camera: CalibratedCamera
    rotation_cam_from_world: FloatArray
    translation_cam_from_world: FloatArray
    true_xy_px: FloatArray
    true_xyz_world: FloatArray
    coverage: float
    extent: float


def board_sets(spec: BoardSpec, seed: int, *, rendered: bool) -> list[BoardSet]:
    """Simulate all sets, from far to near.

    Parameters
    ----------
    rendered : photographs are rendered and their corners detected (needs OpenCV; about 0.1 s a set); otherwise corners
        get Gaussian noise of ``spec.detector_sd_px``. Poses and lidar points are the same either way.

    Raises
    ------
    ValueError
        A board that does not fit into the image at any distance.
    audit.simulate.render.DetectorError
        A rendered corner that the detector does not find.
    """
    return [board for board, _ in iterate_boards(spec, seed, rendered=rendered)]


def iterate_boards(spec: BoardSpec, seed: int, *, rendered: bool) -> Iterator[tuple[BoardSet, UInt8Array | None]]:
    """Simulate the sets of `board_sets` one by one, each with its photograph (height, width), None if not rendered."""
    camera, xyz_world = spec.camera, spec.xyz_world
    if rendered:
        from sfm_audit.audit.simulate.render import BoardPainter, detect_corners  # noqa: PLC0415 - needs OpenCV

        painter = BoardPainter.of(camera, spec.num_corners)
    for i, extent in enumerate(np.linspace(spec.min_extent, spec.max_extent, spec.num_sets)):
        pose_rng, lidar_rng, image_rng = np.random.default_rng([seed, i]).spawn(3)
        pose = _place(spec, extent, pose_rng)
        photograph = None
        if rendered:
            photograph = painter.photograph(pose, image_rng)
            xy_px = detect_corners(photograph, pose.xy_px, spec.num_corners, image_rng)
        else:
            xy_px = pose.xy_px + spec.detector_sd_px * image_rng.standard_normal(pose.xy_px.shape)
        correspondences = scan_from(pose, xyz_world, spec, xy_px, lidar_rng)
        yield (
            BoardSet(
                correspondences,
                camera,
                pose.rotation_cam_from_world,
                pose.translation_cam_from_world,
                pose.xy_px,
                xyz_world,
                coverage(xy_px, spec.width, spec.height),
                _extent_of(spec, float(pose.translation_cam_from_world[2])),
            ),
            photograph,
        )


def scan_from(
    pose: BoardPose, xyz_world: FloatArray, spec: BoardSpec, xy_px: FloatArray, rng: np.random.Generator
) -> Correspondences:
    """Scan the board from the camera's centre, and pair its points with detected corners (n, 2)."""
    scanned = scan(pose.xyz_cam(xyz_world), spec.lidar, rng)
    rotation, translation = pose.rotation_cam_from_world, pose.translation_cam_from_world
    measured, pan, tilt = (
        (xyz_cam - translation) @ rotation for xyz_cam in (scanned.xyz, scanned.pan_xyz, scanned.tilt_xyz)
    )
    return Correspondences(spec.width, spec.height, xy_px, measured, pan, tilt)


def _place(spec: BoardSpec, extent: float, rng: np.random.Generator) -> BoardPose:
    """Rotate a board at random and push it back until all corners are inside the image."""
    angles_deg = rng.uniform(-spec.max_tilt_deg, spec.max_tilt_deg, 3)
    rotation = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    camera, xyz_world = spec.camera, spec.xyz_world
    nearest = distance = _HALF_WIDTH / extent * 2.0 * spec.focal_px / spec.width
    limit = np.array([spec.width, spec.height]) - BORDER_PX
    while distance < _FARTHEST * nearest:
        translation = np.array([0.0, 0.0, distance])
        pose = BoardPose(rotation, translation, camera.project(xyz_world @ rotation.T + translation).xy_px.T)
        if np.all((pose.xy_px >= BORDER_PX) & (pose.xy_px <= limit)):  # false for NaN
            return pose
        distance *= _BACK
    raise ValueError(f"a board of extent {extent:.3g} does not fit into {spec.width} x {spec.height} px")


def _extent_of(spec: BoardSpec, distance: float) -> float:
    return _HALF_WIDTH / distance * 2.0 * spec.focal_px / spec.width
