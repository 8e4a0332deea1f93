"""What the files of a model say, before anything is put together: the same tables for all formats.

Images and cameras are sorted by id; 3D points and tracks stay in the order of the file (``order`` sorts them).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray, UInt32Array, UInt64Array
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.model import CameraTable, Finding
from sfm_audit.loaders.paths.locations import InputPath

UNLINKED: Final = np.uint64(2**64 - 1)
Sensor = tuple[int, int]
CAMERA_SENSOR: Final = 0
IDENTITY_POSE: Final = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
Pose = tuple[float, ...]
_MOST_AT_ONCE: Final = 1 << 21  # 2D points for which memory is asked; more are put together afterwards
_Linked = tuple[UInt32Array, FloatArray, UInt64Array]


@dataclass(frozen=True, slots=True, eq=False)
class RawImages:
    """The images file, sorted by image_id; of its POINTS2D only the linked ones.

    poses: (I, 7) quaternion w x y z and translation, cam_from_world, as stored.
    offsets: (I + 1,), image i owns rows offsets[i]:offsets[i + 1] of the last three.
    point3d_id: (M,), never `UNLINKED`.
    num_unused_nonfinite: unlinked 2D points that are not finite; only text is asked, where COLMAP cannot read them.
    """

    image_id: UInt32Array
    name: tuple[str, ...]
    camera_id: UInt32Array
    poses: FloatArray
    num_points2d: IntArray
    offsets: IntArray
    point2d_idx: UInt32Array
    xy_px: FloatArray
    point3d_id: UInt64Array
    num_unused_nonfinite: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RawPoints:
    """The points3D file in its own order; ``order`` (P,) sorts its points by id.

    track_lengths: (P,). track_image_id, track_point2d_idx: (T,), the tracks one after the other.
    has_tracks: False for a format that stores no tracks: there is then nothing to compare the images' links with.
    num_unused_nonfinite: points whose colour is no whole number, which only text can say.
    """

    point3d_id: UInt64Array
    xyz_world: FloatArray
    stored_error_px: FloatArray
    order: IntArray
    track_lengths: IntArray
    track_image_id: UInt32Array
    track_point2d_idx: UInt32Array
    has_tracks: bool = True
    num_unused_nonfinite: int = 0


@dataclass(frozen=True, slots=True)
class RawRig:
    """One rig: sensor_from_rig of every sensor, None where the file has no pose; identity for the reference sensor."""

    rig_id: int
    sensor_from_rig: dict[Sensor, Pose | None]


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame: where its rig was, the images it consists of, and the camera that it names for each of them."""

    frame_id: int
    rig_id: int
    rig_from_world: Pose
    image_ids: tuple[int, ...]
    sensor_ids: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RawModel:
    """All files of one model. rigs and frames: None where the file does not exist."""

    cameras: CameraTable
    images: RawImages
    points: RawPoints
    rigs: tuple[RawRig, ...] | None
    frames: tuple[RawFrame, ...] | None
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RawCamera:
    """One camera as stored."""

    camera_id: int
    model_id: int
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """One image as stored, with the linked ones of its POINTS2D."""

    image_id: int
    pose: Pose
    camera_id: int
    name: str
    num_points2d: int
    point2d_idx: UInt32Array
    xy_px: FloatArray
    point3d_id: UInt64Array
    num_unused_nonfinite: int = 0


def camera_table(cameras: Sequence[RawCamera]) -> CameraTable:
    """Return the cameras as columns, sorted by id."""
    rows = sorted(cameras, key=lambda camera: camera.camera_id)
    return CameraTable(
        camera_id=np.array([row.camera_id for row in rows], dtype=np.uint32),
        model_id=np.array([row.model_id for row in rows], dtype=np.int64),
        width=np.array([row.width for row in rows], dtype=np.int64),
        height=np.array([row.height for row in rows], dtype=np.int64),
        params=np.array([value for row in rows for value in row.params], dtype=np.float64),
        param_offsets=offsets_of([len(row.params) for row in rows]),
    )


class LinkedPoints:
    """The linked 2D points of all images, one image behind the other; memory is touched where something is written.

    Parameters
    ----------
    capacity : how many there can be, as far as the size of a file says
    """

    def __init__(self, capacity: int) -> None:
        self._full: list[_Linked] = []
        self._open = _no_linked(min(capacity, _MOST_AT_ONCE))
        self._num = 0

    def add(self, fields: UInt64Array) -> _Linked:
        """Take an image's POINTS2D (n, 3), bits of x, y and the point's id; return what is kept of the linked ones."""
        chosen = np.flatnonzero(fields[:, 2] != UNLINKED)
        linked = fields if len(chosen) == len(fields) else fields.take(chosen, axis=0)
        if self._num + len(chosen) > len(self._open[0]):
            self._full.append(self._written)
            self._open, self._num = _no_linked(max(len(chosen), _MOST_AT_ONCE)), 0
        own = slice(self._num, self._num + len(chosen))
        self._num = own.stop
        point2d_idx, xy_px, point3d_id = self._open[0][own], self._open[1][own], self._open[2][own]
        point2d_idx[:], xy_px.view(np.uint64)[:], point3d_id[:] = chosen, linked[:, :2], linked[:, 2]
        return point2d_idx, xy_px, point3d_id

    @property
    def _written(self) -> _Linked:
        point2d_idx, xy_px, point3d_id = self._open
        return point2d_idx[: self._num], xy_px[: self._num], point3d_id[: self._num]

    def columns(self) -> _Linked:
        """Positions in POINTS2D, px and ids of the points, of all images in the order in which they came."""
        if not self._full:
            return self._written
        point2d_idx, xy_px, point3d_id = zip(*self._full, self._written, strict=True)
        return np.concatenate(point2d_idx), np.concatenate(xy_px), np.concatenate(point3d_id)


def _no_linked(capacity: int) -> _Linked:
    return np.empty(capacity, np.uint32), np.empty((capacity, 2)), np.empty(capacity, np.uint64)


def image_columns(images: Sequence[RawImage], linked: LinkedPoints | None = None) -> RawImages:
    """Return the images as columns, sorted by id; ``linked`` holds their 2D points, in the order of ``images``."""
    rows = sorted(images, key=lambda image: image.image_id)
    if linked is not None and all(row is image for row, image in zip(rows, images, strict=True)):
        point2d_idx, xy_px, point3d_id = linked.columns()
    else:
        no_ids, no_xy, no_idx = np.empty(0, np.uint64), np.empty((0, 2)), np.empty(0, np.uint32)
        point2d_idx = np.concatenate([no_idx, *(row.point2d_idx for row in rows)])
        xy_px = np.concatenate([no_xy, *(row.xy_px for row in rows)])
        point3d_id = np.concatenate([no_ids, *(row.point3d_id for row in rows)])
    return RawImages(
        image_id=np.array([row.image_id for row in rows], dtype=np.uint32),
        name=tuple(row.name for row in rows),
        camera_id=np.array([row.camera_id for row in rows], dtype=np.uint32),
        poses=np.array([row.pose for row in rows], dtype=np.float64).reshape(-1, 7),
        num_points2d=np.array([row.num_points2d for row in rows], dtype=np.int64),
        offsets=offsets_of([len(row.point3d_id) for row in rows]),
        point2d_idx=point2d_idx,
        xy_px=xy_px,
        point3d_id=point3d_id,
        num_unused_nonfinite=sum(row.num_unused_nonfinite for row in rows),
    )


def offsets_of(lengths: Sequence[int] | IntArray) -> IntArray:
    """Return (n + 1,) offsets of n slices of the given lengths."""
    offsets = np.zeros(len(lengths) + 1, dtype=np.int64)
    np.cumsum(lengths, out=offsets[1:])
    return offsets


def order_of_points(path: InputPath, point3d_id: UInt64Array, position: Callable[[int], Position]) -> IntArray:
    """Return the permutation that sorts ``point3d_id``.

    Raises
    ------
    MalformedFileError
        Where an id occurs twice; ``position`` tells where in the file a row lies.
    """
    if bool(np.all(point3d_id[1:] > point3d_id[:-1])):
        return np.arange(len(point3d_id), dtype=np.int64)
    order = np.argsort(point3d_id, kind="stable")
    ids = point3d_id[order]
    repeated = np.flatnonzero(ids[1:] == ids[:-1])
    if len(repeated):
        row = int(order[repeated + 1].min())
        raise duplicate_id(path, position(row), "3D point", int(point3d_id[row]))
    return order


def duplicate_id(path: InputPath, position: Position, kind: str, item_id: int) -> MalformedFileError:
    """Return the error for an id that the file has used before."""
    wanted = f"a {kind} id that the file has not used before"
    return MalformedFileError(str(path), position, wanted, f"id {item_id} again", "export the reconstruction again")


def check_camera(path: InputPath, position: Position, camera: RawCamera) -> None:
    """Raise MalformedFileError where the size of ``camera`` does not fit the 32 bits that the tables give it."""
    if max(camera.width, camera.height) >= 2**32:
        got = f"{camera.width} x {camera.height}"
        advice = "export the reconstruction again"
        raise MalformedFileError(str(path), position, "an image size below 2^32 px", got, advice)
