"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin, rigs.bin, frames.bin.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``; little endian, no padding, no checksum.
Counts are compared with the size of the file before anything is allocated for them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BufferedReader
from typing import Final, TypeVar

import numpy as np

from sfm_audit.loaders.arrays import IntArray, UInt32Array
from sfm_audit.loaders.assembly.raw import (
    CAMERA_SENSOR,
    IDENTITY_POSE,
    UNLINKED,
    Pose,
    RawCamera,
    RawFrame,
    RawImage,
    RawImages,
    RawModel,
    RawPoints,
    RawRig,
    Sensor,
    camera_table,
    check_camera,
    duplicate_id,
    image_columns,
    order_of_points,
)
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.errors import LoadError, MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.model import CameraTable
from sfm_audit.loaders.paths.files import exists, open_input, read_bytes, reading
from sfm_audit.loaders.paths.locations import InputPath

_COUNT: Final = struct.Struct("<Q")
_CAMERA: Final = struct.Struct("<IiQQ")
_IMAGE: Final = struct.Struct("<I7dI")
_POINT2D_SIZE: Final = 24
_POINT3D: Final = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")]
)
_TRACK_LENGTH_AT: Final = 43
_RIG: Final = struct.Struct("<II")
_SENSOR: Final = struct.Struct("<iI")
_SENSOR_WITH_FLAG: Final = struct.Struct("<iIB")
_POSE: Final = struct.Struct("<7d")
_FRAME: Final = struct.Struct("<II7dI")
_FRAME_DATA: Final = struct.Struct("<iIQ")
_NAME_CHUNK: Final = 256
_RECOPY: Final = "copy or export the reconstruction again"


def read_model(folder: InputPath) -> RawModel:
    """Read all binary files of the model in ``folder``; LoadError where one of them cannot be read."""
    return RawModel(
        cameras=read_cameras(folder / "cameras.bin"),
        images=read_images(folder / "images.bin"),
        points=read_points(folder / "points3D.bin"),
        rigs=read_rigs(folder / "rigs.bin") if exists(folder / "rigs.bin") else None,
        frames=read_frames(folder / "frames.bin") if exists(folder / "frames.bin") else None,
    )


class _Cursor:
    """A position in a small file that is held in memory."""

    def __init__(self, path: InputPath) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.offset = 0

    def unpack(self, layout: struct.Struct, what: str) -> tuple[int, ...]:
        """Return the fields of the next record part and step behind it."""
        end = self.offset + layout.size
        if end > len(self.data):
            raise _truncated(self.path, self.offset, what, layout.size, len(self.data) - self.offset)
        values = layout.unpack_from(self.data, self.offset)
        self.offset = end
        return values

    def count(self, kind: str, min_size: int) -> int:
        """Return the number of records that the file announces."""
        (count,) = self.unpack(_COUNT, f"the number of {kind}")
        _check_count(self.path, 0, (count, kind), min_size, len(self.data) - self.offset)
        return count

    def finish(self, kind: str) -> None:
        """Raise where bytes follow the last record."""
        _check_end(self.path, self.offset, len(self.data), kind)


_Record = TypeVar("_Record")


def _read_records(
    path: InputPath, kind: str, min_size: int, read_one: Callable[[_Cursor], tuple[int, _Record]]
) -> list[_Record]:
    """Read a small file: a count, then records that begin with an id that is theirs alone."""
    cursor = _Cursor(path)
    records: dict[int, _Record] = {}
    for _ in range(cursor.count(f"{kind}s", min_size)):
        start = cursor.offset
        item_id, record = read_one(cursor)
        if item_id in records:
            raise duplicate_id(path, Position("byte", start), kind, item_id)
        records[item_id] = record
    cursor.finish(f"{kind}s")
    return list(records.values())


def read_cameras(path: InputPath) -> CameraTable:
    """Read cameras.bin."""
    return camera_table(_read_records(path, "camera", _CAMERA.size, _read_camera))


def _read_camera(cursor: _Cursor) -> tuple[int, RawCamera]:
    start = cursor.offset
    camera_id, model_id, width, height = cursor.unpack(_CAMERA, "a camera")
    model = BY_ID.get(model_id)
    if model is None:
        wanted, got = f"a camera model id from 0 to {max(BY_ID)}", f"model {model_id} of camera {camera_id}"
        advice = "the file is damaged, or newer than this program"
        raise MalformedFileError(str(cursor.path), Position("byte", start + 4), wanted, got, advice)
    params = cursor.unpack(struct.Struct(f"<{model.num_params}d"), f"the parameters of camera {camera_id}")
    camera = RawCamera(camera_id, model_id, width, height, params)
    check_camera(cursor.path, Position("byte", start + 8), camera)
    return camera_id, camera


def read_images(path: InputPath) -> RawImages:
    """Read images.bin, one image in memory at a time, keeping of its POINTS2D the linked ones."""
    file, size = open_input(path)
    with file, reading(path):
        count = num_images(path, file.read(_COUNT.size), size)
        images: dict[int, RawImage] = {}
        offset = _COUNT.size
        for _ in range(count):
            image, end = _read_image(file, path, offset, size)
            if image.image_id in images:
                raise duplicate_id(path, Position("byte", offset), "image", image.image_id)
            images[image.image_id] = image
            offset = end
    _check_end(path, offset, size, "images")
    return image_columns(list(images.values()))


def num_images(path: InputPath, head: bytes, size: int) -> int:
    """Return what the first eight bytes of an images.bin of ``size`` bytes say; LoadError where it is too small."""
    if len(head) < _COUNT.size:
        raise _truncated(path, 0, "the number of images", _COUNT.size, len(head))
    (count,) = _COUNT.unpack(head)
    _check_count(path, 0, (count, "images"), _IMAGE.size + 1 + _COUNT.size, size - _COUNT.size)
    return int(count)


def _read_image(file: BufferedReader, path: InputPath, start: int, size: int) -> tuple[RawImage, int]:
    """Read the image whose record begins at ``start``; return it and where its record ends."""
    head = file.read(_IMAGE.size)
    if len(head) < _IMAGE.size:
        raise _truncated(path, start, "an image", _IMAGE.size, len(head))
    image_id, *pose, camera_id = _IMAGE.unpack(head)
    name, offset = _read_name(file, path, start + _IMAGE.size, image_id)
    file.seek(offset)
    data = file.read(_COUNT.size)
    what = f"the number of 2D points of image {image_id}"
    if len(data) < _COUNT.size:
        raise _truncated(path, offset, what, _COUNT.size, len(data))
    (num_points2d,) = _COUNT.unpack(data)
    kind = f"2D points of image {image_id}"
    _check_count(path, offset, (num_points2d, kind), _POINT2D_SIZE, size - offset - _COUNT.size)
    offset += _COUNT.size
    data = file.read(_POINT2D_SIZE * num_points2d)
    if len(data) < _POINT2D_SIZE * num_points2d:  # the file shrank while it was read
        raise _truncated(path, offset, f"the {kind}", _POINT2D_SIZE * num_points2d, len(data))
    fields = np.frombuffer(data, dtype="<u8").reshape(-1, 3)
    point2d_idx = np.flatnonzero(fields[:, 2] != UNLINKED)
    linked = fields[point2d_idx]
    image = RawImage(
        image_id,
        tuple(pose),
        camera_id,
        name,
        num_points2d,
        point2d_idx,
        np.ascontiguousarray(linked[:, :2]).view("<f8"),
        np.ascontiguousarray(linked[:, 2]),
    )
    return image, offset + len(data)


def _read_name(file: BufferedReader, path: InputPath, start: int, image_id: int) -> tuple[str, int]:
    r"""Return the name that begins at ``start`` and where the byte behind its NUL lies.

    Bytes that are not UTF-8 become ``\xNN``: names go into Parquet text columns.
    """
    pieces: list[bytes] = []
    offset = start
    while True:
        piece = file.read(_NAME_CHUNK)
        end = piece.find(b"\0")
        if end >= 0:
            pieces.append(piece[:end])
            return b"".join(pieces).decode("utf-8", errors="backslashreplace"), offset + end + 1
        pieces.append(piece)
        offset += len(piece)
        if len(piece) < _NAME_CHUNK:
            wanted, got = f"the name of image {image_id}, ended by a NUL byte", "the end of the file"
            raise TruncatedFileError(str(path), Position("byte", start), wanted, got, _RECOPY)


def read_points(path: InputPath) -> RawPoints:
    """Read points3D.bin."""
    data = read_bytes(path)
    if len(data) < _COUNT.size:
        raise _truncated(path, 0, "the number of 3D points", _COUNT.size, len(data))
    (count,) = _COUNT.unpack_from(data)
    _check_count(path, 0, (count, "3D points"), _POINT3D.itemsize, len(data) - _COUNT.size)
    starts, end = _point_starts(data, count, path)
    _check_end(path, end, len(data), "3D points")
    if count == 0:
        records = np.empty(0, _POINT3D)
    else:  # a view that begins a record at every byte; taking rows of it copies the records out
        windows = np.ndarray((len(data) - _POINT3D.itemsize + 1,), f"V{_POINT3D.itemsize}", data, strides=(1,))
        records = windows[starts].view(_POINT3D)
    track_lengths = records["track_length"].astype(np.int64)
    tracks = _gather_tracks(data, starts + _POINT3D.itemsize, track_lengths)
    point3d_id = records["id"].astype(np.uint64)
    return RawPoints(
        point3d_id=point3d_id,
        xyz_world=records["xyz"].astype(np.float64),
        stored_error_px=records["error"].astype(np.float64),
        order=order_of_points(path, point3d_id, lambda row: Position("byte", int(starts[row]))),
        track_lengths=track_lengths,
        track_image_id=tracks[:, 0].copy(),
        track_point2d_idx=tracks[:, 1].copy(),
    )


def _point_starts(data: bytes, count: int, path: InputPath) -> tuple[IntArray, int]:
    """Return where each record begins and where the last one ends: record = 51 + 8 * track length bytes."""
    starts = [0] * count
    offset, size = _COUNT.size, len(data)
    unpack = _COUNT.unpack_from
    row = 0
    while row < count and offset + 51 <= size:
        starts[row] = offset
        offset += 51 + 8 * unpack(data, offset + _TRACK_LENGTH_AT)[0]
        row += 1
    if offset > size:
        at = starts[row - 1] + _TRACK_LENGTH_AT
        kind = f"elements of the track of 3D point {row} of {count}"
        _check_count(path, at, (unpack(data, at)[0], kind), 8, size - at - 8)
    if row < count:
        raise _truncated(path, offset, f"3D point {row + 1} of {count}", _POINT3D.itemsize, size - offset)
    return np.array(starts, dtype=np.int64), offset


def _gather_tracks(data: bytes, starts: IntArray, lengths: IntArray) -> UInt32Array:
    """Return (T, 2) image ids and POINT2D indices of the tracks that begin at the bytes ``starts``."""
    total = int(lengths.sum())
    if total == 0:
        return np.empty((0, 2), np.uint32)
    first = np.cumsum(lengths) - lengths
    at = np.arange(total, dtype=np.int64)
    at *= 8
    at += np.repeat(starts - 8 * first, lengths)
    windows = np.ndarray((len(data) - 7,), "V8", data, strides=(1,))
    return windows[at].view("<u4").reshape(-1, 2)


def read_rigs(path: InputPath) -> tuple[RawRig, ...]:
    """Read rigs.bin (COLMAP 3.12 and newer)."""
    return tuple(_read_records(path, "rig", _RIG.size, _read_rig))


def _read_rig(cursor: _Cursor) -> tuple[int, RawRig]:
    rig_id, num_sensors = cursor.unpack(_RIG, "a rig")
    sensors: dict[Sensor, Pose | None] = {}
    if num_sensors > 0:
        kind, sensor_id = cursor.unpack(_SENSOR, f"the reference sensor of rig {rig_id}")
        sensors[(kind, sensor_id)] = IDENTITY_POSE
        left = len(cursor.data) - cursor.offset
        sensors_left = (num_sensors - 1, f"more sensors of rig {rig_id}")
        _check_count(cursor.path, cursor.offset - _SENSOR.size - 4, sensors_left, _SENSOR_WITH_FLAG.size, left)
    for _ in range(num_sensors - 1):
        start = cursor.offset
        kind, sensor_id, has_pose = cursor.unpack(_SENSOR_WITH_FLAG, f"a sensor of rig {rig_id}")
        if (kind, sensor_id) in sensors:
            raise duplicate_id(cursor.path, Position("byte", start), f"sensor of rig {rig_id}", sensor_id)
        sensors[(kind, sensor_id)] = cursor.unpack(_POSE, f"a sensor pose of rig {rig_id}") if has_pose else None
    return rig_id, RawRig(rig_id, sensors)


def read_frames(path: InputPath) -> tuple[RawFrame, ...]:
    """Read frames.bin (COLMAP 3.12 and newer)."""
    return tuple(_read_records(path, "frame", _FRAME.size, _read_frame))


def _read_frame(cursor: _Cursor) -> tuple[int, RawFrame]:
    frame_id, rig_id, *pose, num_data = cursor.unpack(_FRAME, "a frame")
    left = len(cursor.data) - cursor.offset
    _check_count(cursor.path, cursor.offset - 4, (num_data, f"data of frame {frame_id}"), _FRAME_DATA.size, left)
    data = [cursor.unpack(_FRAME_DATA, f"the data of frame {frame_id}") for _ in range(num_data)]
    images = tuple(data_id for kind, _, data_id in data if kind == CAMERA_SENSOR)
    return frame_id, RawFrame(frame_id, rig_id, tuple(pose), images)


def _check_count(path: InputPath, offset: int, items: tuple[int, str], min_size: int, num_left: int) -> None:
    """Raise where that many items of at least ``min_size`` bytes cannot fit into what is left of the file."""
    count, kind = items
    if count * min_size > num_left:
        wanted = f"{count} {kind}, at least {count * min_size} bytes"
        advice = f"the file is cut short or damaged: {_RECOPY}"
        raise TruncatedFileError(str(path), Position("byte", offset), wanted, f"{num_left} bytes", advice)


def _check_end(path: InputPath, offset: int, size: int, kind: str) -> None:
    if offset != size:
        got = f"{size - offset} more bytes"
        wanted = f"the end of the file after the last of its {kind}"
        raise MalformedFileError(str(path), Position("byte", offset), wanted, got, f"the file is damaged: {_RECOPY}")


def _truncated(path: InputPath, offset: int, what: str, num_wanted: int, num_left: int) -> LoadError:
    wanted = f"{what} ({num_wanted} bytes)"
    got = f"{max(num_left, 0)} bytes before the end of the file"
    return TruncatedFileError(str(path), Position("byte", offset), wanted, got, f"the file is cut short: {_RECOPY}")
