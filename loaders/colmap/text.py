"""COLMAP's text files: cameras.txt, images.txt, points3D.txt, rigs.txt, frames.txt.

Source: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_text.cc``. Unlike COLMAP this reader accepts names with blanks
(the name is the rest of its line), and refuses a file whose last lines are missing.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import UInt64Array
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
    RawRig,
    Sensor,
    camera_table,
    check_camera,
    duplicate_id,
    image_columns,
)
from sfm_audit.loaders.camera_models import BY_NAME, COLMAP_MODELS
from sfm_audit.loaders.colmap.last_record import check_last_image, check_last_point
from sfm_audit.loaders.colmap.text_points import read_points
from sfm_audit.loaders.errors import Position
from sfm_audit.loaders.model import CameraTable, Finding
from sfm_audit.loaders.paths.files import exists
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import (
    POINTS,
    TextFile,
    check_count,
    check_text,
    parse_floats,
    parse_uint,
    read_text,
    repr_token,
)

_SENSORS: Final = {b"CAMERA": CAMERA_SENSOR, b"IMU": 1, b"INVALID": -1}
_EXACT: Final = 2.0**53
_HEADER: Final = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


def read_model(folder: InputPath) -> RawModel:
    """Read all text files of the model in ``folder``; LoadError where one of them cannot be read."""
    camera_file = read_text(folder / "cameras.txt")
    cameras = read_cameras(camera_file)
    image_file = read_text(folder / "images.txt")
    images = read_images(image_file)
    # COLMAP's FAQ makes known poses a model with an empty points3D.txt; check_count refuses it where points are missing
    point_file = read_text(folder / "points3D.txt", may_be_empty=True)
    points = read_points(point_file)
    rigs, rig_findings = read_rigs(folder / "rigs.txt") if exists(folder / "rigs.txt") else (None, ())
    frames, frame_findings = read_frames(folder / "frames.txt") if exists(folder / "frames.txt") else (None, ())

    def lacks_cameras() -> bool:
        return not bool(np.isin(images.camera_id, cameras.camera_id).all())

    def lacks_images() -> bool:
        ids = [image_id for frame in frames or () for image_id in frame.image_ids]
        in_frames = np.isin(np.array(ids, dtype=np.uint64), images.image_id).all()
        return not bool(in_frames and np.isin(points.track_image_id, images.image_id).all())

    def lacks_points() -> bool:
        return not bool(np.isin(images.point3d_id, points.point3d_id).all())

    findings = (
        *check_count(camera_file, "cameras", len(cameras), has_missing=lacks_cameras),
        *check_count(image_file, "images", len(images.image_id), has_missing=lacks_images),
        *check_count(point_file, POINTS, len(points.order), has_missing=lacks_points),
        *rig_findings,
        *frame_findings,
    )
    check_last_image(image_file, images, points)
    check_last_point(point_file, images, points)
    return RawModel(cameras, images, points, rigs, frames, findings)


def check_structure(folder: InputPath) -> None:
    """Raise LoadError where a file of the model holds a NUL byte, as one that was grown by zeros does."""
    for name in ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"):
        if exists(folder / name):
            check_text(folder / name, may_be_empty=name == "points3D.txt")


def read_cameras(file: TextFile) -> CameraTable:
    """Read cameras.txt."""
    cameras: dict[int, RawCamera] = {}
    for line, record in file.records():
        camera = _read_camera(file, line, record.split())
        if camera.camera_id in cameras:
            raise duplicate_id(file.path, Position("line", line), "camera", camera.camera_id)
        check_camera(file.path, Position("line", line), camera)
        cameras[camera.camera_id] = camera
    return camera_table(list(cameras.values()))


def _read_camera(file: TextFile, line: int, tokens: list[bytes]) -> RawCamera:
    if len(tokens) < 4:
        raise file.malformed(line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", f"{len(tokens)} values")
    camera_id = parse_uint(file, line, tokens[0], "a camera id")
    model = BY_NAME.get(tokens[1].decode("ascii", errors="backslashreplace"))
    if model is None or not model.is_colmap:
        known = ", ".join(each.name for each in COLMAP_MODELS)
        raise file.malformed(line, f"a camera model ({known})", repr_token(tokens[1]))
    width = parse_uint(file, line, tokens[2], "an image width", bits=64)
    height = parse_uint(file, line, tokens[3], "an image height", bits=64)
    params = tokens[4:]
    if len(params) != model.num_params:
        raise file.malformed(line, f"{model.num_params} parameters of {model.name}", f"{len(params)}")
    values = parse_floats(file, line, params, f"the parameters of camera {camera_id}")
    return RawCamera(camera_id, model.model_id, width, height, tuple(values.tolist()))


def read_images(file: TextFile) -> RawImages:
    """Read images.txt: two lines per image, the second possibly empty."""
    images: dict[int, RawImage] = {}
    lines = iter(enumerate(file.lines, start=1))
    for line, header in lines:
        stripped = header.strip()
        if not stripped or stripped.startswith(b"#"):
            continue
        points2d_line, points2d = next(lines, (line + 1, None))
        if points2d is None:
            raise file.truncated("a line of POINTS2D after each image's line (it may be empty)", "the end of the file")
        image = _read_image(file, line, stripped, points2d_line, points2d)
        if image.image_id in images:
            raise duplicate_id(file.path, Position("line", line), "image", image.image_id)
        images[image.image_id] = image
    return image_columns(list(images.values()))


def _read_image(file: TextFile, line: int, header: bytes, points2d_line: int, points2d: bytes) -> RawImage:
    tokens = header.split(maxsplit=9)
    if len(tokens) < 10:
        raise file.malformed(line, _HEADER, f"{len(tokens)} values")
    numbers = tokens[:9]
    image_id = parse_uint(file, line, numbers[0], "an image id")
    pose = parse_floats(file, line, numbers[1:8], f"the pose of image {image_id}")
    camera_id = parse_uint(file, line, numbers[8], "a camera id")
    name = tokens[9].decode("utf-8", errors="backslashreplace")
    fields = points2d.split()
    if len(fields) % 3:
        raise file.malformed(points2d_line, f"X Y POINT3D_ID of the 2D points of image {image_id}", _uneven(fields, 3))
    what = f"the 2D points of image {image_id}"
    values = parse_floats(file, points2d_line, fields, what).reshape(-1, 3)
    ids = _point_ids(file, points2d_line, fields, values[:, 2])
    point2d_idx = np.flatnonzero(ids != UNLINKED)
    linked = point2d_idx.astype(np.uint32)
    return RawImage(
        image_id,
        tuple(pose.tolist()),
        camera_id,
        name,
        len(values),
        linked,
        values[linked, :2],
        ids[linked],
        int(np.count_nonzero(~np.isfinite(values[ids == UNLINKED, :2]).all(axis=1))),
    )


def _point_ids(file: TextFile, line: int, fields: list[bytes], as_float: np.ndarray) -> UInt64Array:
    """Return the point ids of a POINTS2D line exactly; `UNLINKED` for -1."""
    if bool(np.all((as_float >= -1) & (as_float < _EXACT) & (as_float == np.floor(as_float)))):
        return as_float.astype(np.int64).astype(np.uint64)  # -1 becomes 2^64 - 1
    ids = [
        UNLINKED if token == b"-1" else parse_uint(file, line, token, "a 3D point id or -1", 64)
        for token in fields[2::3]
    ]
    return np.array(ids, dtype=np.uint64)


def read_rigs(path: InputPath) -> tuple[tuple[RawRig, ...], tuple[Finding, ...]]:
    """Read rigs.txt (COLMAP 3.12 and newer): what it holds, and findings where it contradicts itself."""
    file = read_text(path)
    rigs: dict[int, RawRig] = {}
    for line, record in file.records():
        rig = _read_rig(_Fields(file, line, record))
        if rig.rig_id in rigs:
            raise duplicate_id(path, Position("line", line), "rig", rig.rig_id)
        rigs[rig.rig_id] = rig
    return tuple(rigs.values()), check_count(file, "rigs", len(rigs), has_missing=lambda: True, needs_line_end=True)


class _Fields:
    """The values of one line, taken one after the other."""

    def __init__(self, file: TextFile, line: int, record: bytes) -> None:
        self.file = file
        self.line = line
        self.tokens = record.split()
        self.next = 0

    def take(self, num: int, what: str) -> list[bytes]:
        """Return the next ``num`` values."""
        tokens = self.tokens[self.next : self.next + num]
        if len(tokens) < num:
            raise self.file.malformed(self.line, f"{num} more values: {what}", f"{len(tokens)}")
        self.next += num
        return tokens

    def uint(self, what: str, bits: int = 32) -> int:
        """Return the next value, an unsigned integer."""
        return parse_uint(self.file, self.line, self.take(1, what)[0], what, bits)

    def pose(self, what: str) -> Pose:
        """Return the next seven values, a pose."""
        return tuple(parse_floats(self.file, self.line, self.take(7, what), what).tolist())

    def sensor(self) -> Sensor:
        """Return the next two values, a sensor's kind and id."""
        (kind,) = self.take(1, "a sensor type")
        if kind not in _SENSORS:
            raise self.file.malformed(self.line, "a sensor type (CAMERA, IMU)", repr_token(kind))
        return _SENSORS[kind], self.uint("a sensor id")

    def finish(self) -> None:
        """Raise where the line goes on."""
        if self.next < len(self.tokens):
            rest = f"{len(self.tokens) - self.next} more values"
            raise self.file.malformed(self.line, "the end of the line", rest)


def _read_rig(fields: _Fields) -> RawRig:
    rig_id = fields.uint("a rig id")
    num_sensors = fields.uint("a number of sensors")
    sensors: dict[Sensor, Pose | None] = {}
    if num_sensors > 0:
        sensors[fields.sensor()] = IDENTITY_POSE
    for _ in range(num_sensors - 1):
        sensor = fields.sensor()
        if sensor in sensors:
            raise duplicate_id(fields.file.path, Position("line", fields.line), f"sensor of rig {rig_id}", sensor[1])
        has_pose = fields.uint("0 or 1: whether the sensor has a pose", bits=1)
        sensors[sensor] = fields.pose("sensor_from_rig") if has_pose else None
    fields.finish()
    return RawRig(rig_id, sensors)


def read_frames(path: InputPath) -> tuple[tuple[RawFrame, ...], tuple[Finding, ...]]:
    """Read frames.txt (COLMAP 3.12 and newer): what it holds, and findings where it contradicts itself."""
    file = read_text(path)
    frames: dict[int, RawFrame] = {}
    for line, record in file.records():
        frame = _read_frame(_Fields(file, line, record))
        if frame.frame_id in frames:
            raise duplicate_id(path, Position("line", line), "frame", frame.frame_id)
        frames[frame.frame_id] = frame
    return tuple(frames.values()), check_count(
        file, "frames", len(frames), has_missing=lambda: True, needs_line_end=True
    )


def _read_frame(fields: _Fields) -> RawFrame:
    frame_id = fields.uint("a frame id")
    rig_id = fields.uint("a rig id")
    pose = fields.pose("rig_from_world")
    data = [(fields.sensor(), fields.uint("a data id", 64)) for _ in range(fields.uint("a number of data"))]
    fields.finish()
    seen = [(data_id, sensor_id) for (kind, sensor_id), data_id in data if kind == CAMERA_SENSOR]
    return RawFrame(frame_id, rig_id, pose, tuple(each[0] for each in seen), tuple(each[1] for each in seen))


def _uneven(fields: list[bytes], size: int) -> str:
    return f"{len(fields)} values, no multiple of {size}"
