"""A room with annotated lidar points, and boards before its camera: stand-ins for the paper's two real cameras.

The paper's images and lidar scans are not public. "plain" stands for axisp3364, "wide" for axis223m: the second has the
stronger distortion and the poorer corners; both have fx != fy and a principal point off the middle, so that of the
paper's models only M5 is right. The numbers are ours; docs/simulate.md compares what they lead to with the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.simulate.lidar_scan import LidarSpec, scan
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

_ESTIMATED: Final = ("fx", "fy", "cx", "cy", "k1", "k2", "k3")


def _camera(
    size: tuple[int, int], focal_px: tuple[float, float], centre_px: tuple[float, float], k: tuple[float, float, float]
) -> CalibratedCamera:
    return CalibratedCamera(*size, Distortion.FORWARD, focal_px, centre_px, np.array(k), _ESTIMATED)


ROOM_CAMERAS: Final = MappingProxyType(
    {
        "plain": _camera((1280, 960), (905.0, 911.0), (650.0, 472.0), (-0.22, 0.18, -0.05)),
        "wide": _camera((1600, 1200), (1010.0, 1023.0), (818.0, 588.0), (-0.31, 0.16, -0.03)),
    }
)
CORNER_SD_PX: Final = MappingProxyType({"plain": 0.19, "wide": 0.81})  # the paper's M5 on held-out views
_LIDAR: Final = LidarSpec(pan_step_rad=5e-4, tilt_step_rad=5e-5, sd_steps=0.6)
_BORDER_PX: Final = 8.0
_ROOM: Final = np.array([[-3.0, -1.4, -2.0], [3.0, 1.6, 7.0]])  # walls, floor and ceiling about the scanner, m
_CAMERA: Final = np.array([0.4, -0.3, 0.2])  # m from the scanner
_TURN_DEG: Final = (10.0, 20.0, 5.0)  # about x, y, z
_FURNITURE: Final = 0.5  # points lie between that share of the way to the wall and the wall
_BOARD_TILT_DEG: Final = (35.0, 35.0, 15.0)
_BOARD_SHARE: Final = (0.3, 0.75)  # of the image's height that a board takes
_MAX_DRAWS: Final = 1000


@dataclass(frozen=True, slots=True)
class RoomSpec:
    """An image of the room, 6 m x 3 m x 9 m, with a scanner half a metre beside the camera.

    camera_name: "plain" or "wide".         num_points: annotated.
    annotation_sd_px: of an annotated pixel, per axis.         lidar: of the points.
    """

    camera_name: str = "plain"
    num_points: int = 24
    annotation_sd_px: float = 0.7
    lidar: LidarSpec = _LIDAR

    def __post_init__(self) -> None:
        camera_named(self.camera_name)
        if self.num_points < 1:
            raise ValueError(f"need a point, got {self.num_points}")


@dataclass(frozen=True, slots=True, eq=False)
class RoomSet:
    """One image of a room: what was measured, and the truth. The world is the scanner (x right, y down, z ahead), m.

    correspondences: annotated pixels, points as the lidar has them, and their neighbours in the scan.
    rotation_cam_from_world: (3, 3).    translation_cam_from_world: (3,) m.
    true_xy_px: (n, 2).                 true_xyz_world: (n, 3) m.
    """

    correspondences: Correspondences
    true_camera: CalibratedCamera
    rotation_cam_from_world: FloatArray
    translation_cam_from_world: FloatArray
    true_xy_px: FloatArray
    true_xyz_world: FloatArray


def camera_named(name: str) -> CalibratedCamera:
    """Return one of the two cameras; ValueError for another name."""
    if name not in ROOM_CAMERAS:
        raise ValueError(f"unknown camera {name!r}; there are {', '.join(ROOM_CAMERAS)}")
    return ROOM_CAMERAS[name]


def room_sets(spec: RoomSpec, seed: int, num_sets: int) -> list[RoomSet]:
    """Simulate images of the room, each with another pose and other points; a longer list begins like a shorter one."""
    return [_room_set(spec, np.random.default_rng([seed, i])) for i in range(num_sets)]


def _room_set(spec: RoomSpec, rng: np.random.Generator) -> RoomSet:
    camera = camera_named(spec.camera_name)
    rotation = Rotation.from_euler("xyz", rng.uniform(-1.0, 1.0, 3) * _TURN_DEG, degrees=True).as_matrix()
    translation = -rotation @ _CAMERA
    rays = np.column_stack([camera.undistort(_spread_pixels(camera, spec.num_points, rng)), np.ones(spec.num_points)])
    reach = _to_wall(rays @ rotation) * rng.uniform(_FURNITURE, 1.0, spec.num_points)
    xyz_cam = rays * reach[:, None]
    xyz_world = (xyz_cam - translation) @ rotation
    true_xy_px = camera.project(xyz_cam).xy_px.T
    xy_px = true_xy_px + spec.annotation_sd_px * rng.standard_normal(true_xy_px.shape)
    scanned = scan(xyz_world, spec.lidar, rng)
    correspondences = Correspondences(
        camera.width, camera.height, xy_px, scanned.xyz, scanned.pan_xyz, scanned.tilt_xyz
    )
    return RoomSet(correspondences, camera, rotation, translation, true_xy_px, xyz_world)


def _spread_pixels(camera: CalibratedCamera, num: int, rng: np.random.Generator) -> FloatArray:
    """(num, 2) px: one in each of ``num`` different cells of the image, as one picks them who means to cover it."""
    num_columns = int(np.ceil(np.sqrt(num * camera.width / camera.height)))
    num_rows = -(-num // num_columns)
    cell = rng.permutation(num_columns * num_rows)[:num]
    share = np.column_stack([cell % num_columns, cell // num_columns]) + rng.uniform(size=(num, 2))
    size = np.array([camera.width, camera.height])
    return np.asarray(_BORDER_PX + share / [num_columns, num_rows] * (size - 2.0 * _BORDER_PX))


def _to_wall(directions: FloatArray) -> FloatArray:
    """Factor (n,) of directions (n, 3) from the camera, in the world's axes, at which they meet the room's walls."""
    with np.errstate(divide="ignore"):  # parallel to a wall: never met
        factors = np.where(directions > 0.0, _ROOM[1] - _CAMERA, _ROOM[0] - _CAMERA) / directions
    return np.asarray(np.where(directions == 0.0, np.inf, factors).min(axis=1))


def zhang_views(
    camera_name: str, seed: int, num_views: int = 20, *, num_corners: int = 6, corner_sd_px: float | None = None
) -> list[Correspondences]:
    """Simulate views of a flat board for Zhang's method; take some of them to calibrate, hold out the others.

    Parameters
    ----------
    num_corners : per row and column
    corner_sd_px : noise of a corner, px, per axis; by default what M5 left the paper's camera: 0.19 plain, 0.81 wide

    Returns
    -------
    list[Correspondences]
        The world of every view is the board: z = 0, corners one unit apart. No neighbours.
    """
    camera = camera_named(camera_name)
    sd_px = CORNER_SD_PX[camera_name] if corner_sd_px is None else corner_sd_px
    x, y = np.meshgrid(np.arange(float(num_corners)), np.arange(float(num_corners)))
    xyz_board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    views = []
    for i in range(num_views):
        rng = np.random.default_rng([seed, i])
        true_xy_px = _board_in_view(camera, xyz_board - xyz_board.mean(axis=0), rng)
        xy_px = true_xy_px + sd_px * rng.standard_normal(true_xy_px.shape)
        views.append(Correspondences(camera.width, camera.height, xy_px, xyz_board))
    return views


def _board_in_view(camera: CalibratedCamera, xyz_board: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Corners (n, 2) px of a board, drawn until all are inside the image."""
    size = np.array([camera.width, camera.height])
    for _ in range(_MAX_DRAWS):
        tilts_deg = rng.uniform(-1.0, 1.0, 3) * _BOARD_TILT_DEG
        rotation = Rotation.from_euler("xyz", tilts_deg, degrees=True).as_matrix()
        distance = np.ptp(xyz_board[:, 1]) * camera.focal_px[1] / (rng.uniform(*_BOARD_SHARE) * camera.height)
        middle = camera.undistort(rng.uniform(0.2, 0.8, (1, 2)) * size)[0]
        xy_px = camera.project(xyz_board @ rotation.T + distance * np.array([*middle, 1.0])).xy_px.T
        if np.all((xy_px >= _BORDER_PX) & (xy_px <= size - _BORDER_PX)):
            return xy_px
    raise ValueError(f"no board fits into the image of {camera.width} x {camera.height} px")
