"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin, rigs.bin, frames.bin.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``; little endian, no padding, no checksum.
Counts are compared with the size of the file before anything is allocated for them.
"""

from __future__ import annotations

import struct
from io import BufferedReader
from typing import Any, Final

import numpy as np

from sfm_audit.loaders.assembly.raw import (
    CAMERA_SENSOR,
    IDENTITY_POSE,
    LinkedPoints,
    Pose,
    RawCamera,
    RawFrame,
    RawImage,
    RawImages,
    RawModel,
    RawRig,
    Sensor,
    camera_table,
    check_camera,
    duplicate_id,
    image_columns,
)
from sfm_audit.loaders.camera_models import BY_ID, COLMAP_MODELS
from sfm_audit.loaders.colmap.binary_file import COUNT, RECOPY, Cursor, check_count, check_end, read_records, truncated
from sfm_audit.loaders.colmap.binary_points import point_pieces, read_points
from sfm_audit.loaders.errors import MalformedFileError, Position, TruncatedFileError
from sfm_audit.loaders.model import CameraTable
from sfm_audit.loaders.paths.files import exists, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

_CAMERA: Final = struct.Struct("<IiQQ")
_IMAGE: Final = struct.Struct("<I7dI")
_POINT2D_SIZE: Final = 24
_RIG: Final = struct.Struct("<II")
_SENSOR: Final = struct.Struct("<iI")
_SENSOR_WITH_FLAG: Final = struct.Struct("<iIB")
_POSE: Final = struct.Struct("<7d")
_FRAME: Final = struct.Struct("<II7dI")
_FRAME_DATA: Final = struct.Struct("<iIQ")
_NAME_CHUNK: Final = 256
_MAX_CAMERA_BYTES: Final = _CAMERA.size + 8 * max(model.num_params for model in COLMAP_MODELS)


def read_model(folder: InputPath) -> RawModel:
    """Read all binary files of the model in ``folder``; LoadError where one of them cannot be read."""
    return RawModel(
        cameras=read_cameras(folder / "cameras.bin"),
        images=read_images(folder / "images.bin"),
        points=read_points(folder / "points3D.bin"),
        rigs=read_rigs(folder / "rigs.bin") if exists(folder / "rigs.bin") else None,
        frames=read_frames(folder / "frames.bin") if exists(folder / "frames.bin") else None,
    )


def read_cameras(path: InputPath) -> CameraTable:
    """Read cameras.bin."""
    return camera_table(read_records(path, "camera", (_CAMERA.size, _MAX_CAMERA_BYTES), _read_camera))


def _read_camera(cursor: Cursor) -> tuple[int, RawCamera]:
    start = cursor.offset
    camera_id, model_id, width, height = cursor.unpack(_CAMERA, "a camera")
    model = BY_ID.get(model_id)
    if model is None or not model.is_colmap:
        wanted, got = (
            f"a camera model id from 0 to {COLMAP_MODELS[-1].model_id}",
            f"model {model_id} of camera {camera_id}",
        )
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
        count = num_images(path, file.read(COUNT.size), size)
        images: dict[int, RawImage] = {}
        offset = COUNT.size
        linked = LinkedPoints(max(0, size - offset - count * (_IMAGE.size + COUNT.size)) // _POINT2D_SIZE)
        for _ in range(count):
            image, end = _read_image(file, path, (offset, size), linked)
            if image.image_id in images:
                raise duplicate_id(path, Position("byte", offset), "image", image.image_id)
            images[image.image_id] = image
            offset = end
    check_end(path, offset, size, "images")
    return image_columns(list(images.values()), linked)


def num_images(path: InputPath, head: bytes, size: int) -> int:
    """Return what the first eight bytes of an images.bin of ``size`` bytes say; LoadError where it is too small."""
    if len(head) < COUNT.size:
        raise truncated(path, 0, "the number of images", COUNT.size, len(head))
    (count,) = COUNT.unpack(head)
    check_count(path, 0, (count, "images"), _IMAGE.size + 1 + COUNT.size, size - COUNT.size)
    return int(count)


def _skip_image(file: BufferedReader, path: InputPath, start: int, size: int) -> int:
    """Step over the image whose record begins at ``start``; return where its record ends."""
    _, _, num_points2d, offset = _read_image_head(file, path, start, size)
    offset += _POINT2D_SIZE * num_points2d
    file.seek(offset)
    return offset


def _read_image_head(
    file: BufferedReader, path: InputPath, start: int, size: int
) -> tuple[tuple[Any, ...], str, int, int]:
    """Return an image's id, pose and camera id, its name, its number of 2D points, and where these begin."""
    head = file.read(_IMAGE.size)
    if len(head) < _IMAGE.size:
        raise truncated(path, start, "an image", _IMAGE.size, len(head))
    fields = _IMAGE.unpack(head)
    name, offset = _read_name(file, path, start + _IMAGE.size, fields[0])
    file.seek(offset)
    data = file.read(COUNT.size)
    what = f"the number of 2D points of image {fields[0]}"
    if len(data) < COUNT.size:
        raise truncated(path, offset, what, COUNT.size, len(data))
    (num_points2d,) = COUNT.unpack(data)
    kind = f"2D points of image {fields[0]}"
    check_count(path, offset, (num_points2d, kind), _POINT2D_SIZE, size - offset - COUNT.size)
    return fields, name, int(num_points2d), offset + COUNT.size


def _read_image(
    file: BufferedReader, path: InputPath, place: tuple[int, int], linked: LinkedPoints
) -> tuple[RawImage, int]:
    """Read the image whose record begins at ``place[0]`` of a file of ``place[1]`` bytes; return where it ends too."""
    start, size = place
    (image_id, *pose, camera_id), name, num_points2d, offset = _read_image_head(file, path, start, size)
    data = file.read(_POINT2D_SIZE * num_points2d)
    if len(data) < _POINT2D_SIZE * num_points2d:  # the file shrank while it was read
        what = f"the 2D points of image {image_id}"
        raise truncated(path, offset, what, _POINT2D_SIZE * num_points2d, len(data))
    fields = np.frombuffer(data, dtype="<u8").reshape(-1, 3)
    image = RawImage(image_id, tuple(pose), camera_id, name, num_points2d, *linked.add(fields))
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
            raise TruncatedFileError(str(path), Position("byte", start), wanted, got, RECOPY)


def check_structure(folder: InputPath) -> None:
    """Raise LoadError where the records of a model's files do not fill them; keeps nothing of the large ones."""
    read_cameras(folder / "cameras.bin")
    for name, read in (("rigs.bin", read_rigs), ("frames.bin", read_frames)):
        if exists(folder / name):
            read(folder / name)
    path = folder / "images.bin"
    file, size = open_input(path)
    with file, reading(path):
        offset = COUNT.size
        for _ in range(num_images(path, file.read(COUNT.size), size)):
            offset = _skip_image(file, path, offset, size)
    check_end(path, offset, size, "images")
    for _ in point_pieces(folder / "points3D.bin"):
        pass


def read_rigs(path: InputPath) -> tuple[RawRig, ...]:
    """Read rigs.bin (COLMAP 3.12 and newer)."""
    return tuple(read_records(path, "rig", (_RIG.size, None), _read_rig))


def _read_rig(cursor: Cursor) -> tuple[int, RawRig]:
    rig_id, num_sensors = cursor.unpack(_RIG, "a rig")
    sensors: dict[Sensor, Pose | None] = {}
    if num_sensors > 0:
        kind, sensor_id = cursor.unpack(_SENSOR, f"the reference sensor of rig {rig_id}")
        sensors[(kind, sensor_id)] = IDENTITY_POSE
        at, sensors_left = cursor.offset - _SENSOR.size - 4, (num_sensors - 1, f"more sensors of rig {rig_id}")
        check_count(cursor.path, at, sensors_left, _SENSOR_WITH_FLAG.size, cursor.num_left)
    for _ in range(num_sensors - 1):
        start = cursor.offset
        kind, sensor_id, has_pose = cursor.unpack(_SENSOR_WITH_FLAG, f"a sensor of rig {rig_id}")
        if (kind, sensor_id) in sensors:
            raise duplicate_id(cursor.path, Position("byte", start), f"sensor of rig {rig_id}", sensor_id)
        sensors[(kind, sensor_id)] = cursor.unpack(_POSE, f"a sensor pose of rig {rig_id}") if has_pose else None
    return rig_id, RawRig(rig_id, sensors)


def read_frames(path: InputPath) -> tuple[RawFrame, ...]:
    """Read frames.bin (COLMAP 3.12 and newer)."""
    return tuple(read_records(path, "frame", (_FRAME.size, None), _read_frame))


def _read_frame(cursor: Cursor) -> tuple[int, RawFrame]:
    frame_id, rig_id, *pose, num_data = cursor.unpack(_FRAME, "a frame")
    kind = f"data of frame {frame_id}"
    check_count(cursor.path, cursor.offset - 4, (num_data, kind), _FRAME_DATA.size, cursor.num_left)
    data = [cursor.unpack(_FRAME_DATA, f"the data of frame {frame_id}") for _ in range(num_data)]
    seen = [(data_id, sensor_id) for kind, sensor_id, data_id in data if kind == CAMERA_SENSOR]
    image_ids, sensor_ids = tuple(each[0] for each in seen), tuple(each[1] for each in seen)
    return frame_id, RawFrame(frame_id, rig_id, tuple(pose), image_ids, sensor_ids)
