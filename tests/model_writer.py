"""Writes COLMAP models record by record, so that tests can write what no sane program writes.

Independent of the loaders and of pycolmap: plain struct.pack and string formatting after COLMAP's documentation.
"""

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

UNLINKED = 2**64 - 1
MODEL_NAMES = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 4: "OPENCV", 17: "EQUIRECTANGULAR"}
SENSOR_NAMES = {0: "CAMERA", 1: "IMU"}


@dataclass(frozen=True)
class Camera:
    camera_id: int = 1
    model_id: int = 0
    width: int = 640
    height: int = 480
    params: tuple = (500.0, 320.0, 240.0)


@dataclass(frozen=True)
class Image:
    image_id: int
    name: str | bytes
    points2d: tuple = ()  # (x, y, point id)
    pose: tuple = (1.0, 0.0, 0.0, 0.0, 0.125, -0.25, 2.0)
    camera_id: int = 1


@dataclass(frozen=True)
class Point:
    point_id: int
    track: tuple = ()  # (image id, POINT2D index)
    xyz: tuple = (0.5, -0.25, 4.0)
    error: float = 0.75
    rgb: tuple = (1, 2, 3)


@dataclass(frozen=True)
class Rig:
    rig_id: int
    sensors: tuple = ()  # (sensor type, sensor id, pose or None); the first is the reference


@dataclass(frozen=True)
class Frame:
    frame_id: int
    rig_id: int
    pose: tuple
    data: tuple = ()  # (sensor type, sensor id, data id)


@dataclass(frozen=True)
class Model:
    cameras: tuple = ()
    images: tuple = ()
    points: tuple = ()
    rigs: tuple | None = None
    frames: tuple | None = None
    name_of_model: dict = field(default_factory=lambda: dict(MODEL_NAMES))

    def but(self, **changes: object) -> "Model":
        return replace(self, **changes)


def tiny_model() -> Model:
    """Three images (one without observations), three points, nothing wrong with it."""
    return Model(
        cameras=(Camera(1), Camera(7, 2, 800, 600, (700.0, 400.0, 300.0, 0.01))),
        images=(
            Image(3, "a.jpg", ((10.5, 20.25, 12), (30.0, 40.0, UNLINKED), (50.0, 60.0, 5), (1.0, 2.0, 10**9))),
            Image(4, "b c/é.png", ((11.5, 21.25, 5), (31.0, 41.0, 12), (5.0, 6.0, 10**9)), camera_id=7),
            Image(90, "no observations.jpg"),
        ),
        points=(
            Point(5, ((3, 2), (4, 0))),
            Point(12, ((3, 0), (4, 1)), xyz=(1.0, 2.0, 30.0), error=0.5),
            Point(10**9, ((4, 2), (3, 3)), xyz=(-1.0, 0.125, 7.0), error=1.5),
        ),
    )


def rig_model() -> Model:
    """The tiny model with a rig of two cameras; poses of the images file are not those of the rigs."""
    side = (0.8, 0.0, 0.6, 0.0, 0.5, 0.0, 0.25)
    front = (0.6, 0.8, 0.0, 0.0, 1.0, 2.0, 3.0)
    back = (0.0, 0.6, 0.0, 0.8, -1.0, 0.5, 0.0)
    return tiny_model().but(
        rigs=(Rig(2, ((0, 1, None), (0, 7, side), (1, 5, None))),),
        frames=(
            Frame(8, 2, front, ((0, 1, 3), (0, 7, 4), (1, 5, 77))),
            Frame(9, 2, back, ((0, 1, 90),)),
        ),
    )


def noisy_model(seed: int = 0, num_images: int = 5, num_points: int = 60) -> Model:
    """A sound model: cameras side by side before a box of points, two camera models, noise of 0.5 px."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-2.0, -1.5, 5.0), (2.0, 1.5, 7.0), (num_points, 3))
    cameras = (
        Camera(1, 2, 640, 480, (500.0, 320.0, 240.0, 0.0)),
        Camera(7, 4, 640, 480, (520.0, 515.0, 321.0, 239.0, 0.0, 0.0, 0.0, 0.0)),
    )
    images, tracks = [], {point: [] for point in range(num_points)}
    for image in range(num_images):
        camera, centre = cameras[image % 2], (0.3 * image - 0.6, 0.1 * (image % 2), 0.0)
        focal, shift = (500.0, (320.0, 240.0)) if image % 2 == 0 else ((520.0, 515.0), (321.0, 239.0))
        seen = xyz - centre
        xy = seen[:, :2] / seen[:, 2:] * focal + shift + rng.normal(0.0, 0.5, (num_points, 2))
        is_linked = rng.random(num_points) < 0.9
        points2d = tuple(
            (float(x), float(y), point + 1 if is_linked[point] else UNLINKED) for point, (x, y) in enumerate(xy)
        )
        for point in np.flatnonzero(is_linked).tolist():
            tracks[point].append((image + 1, point))
        pose = (1.0, 0.0, 0.0, 0.0, *(-value for value in centre))
        images.append(Image(image + 1, f"{image}.jpg", points2d, pose, camera.camera_id))
    points = (Point(k + 1, tuple(tracks[k]), tuple(map(float, xyz[k])), 0.5) for k in range(num_points))
    return Model(cameras, tuple(images), tuple(points))


def write_binary(folder: Path, model: Model) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in binary_files(model).items():
        (folder / name).write_bytes(content)
    return folder


def write_text(folder: Path, model: Model, *, header: bool = True) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in text_files(model, header=header).items():
        (folder / name).write_bytes(content)
    return folder


def binary_files(model: Model) -> dict[str, bytes]:
    files = {
        "cameras.bin": _many(model.cameras, _camera),
        "images.bin": _many(model.images, _image),
        "points3D.bin": _many(model.points, _point),
    }
    if model.rigs is not None:
        files["rigs.bin"] = _many(model.rigs, _rig)
    if model.frames is not None:
        files["frames.bin"] = _many(model.frames, _frame)
    return files


def _many(records, pack) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(map(pack, records))


def _camera(c: Camera) -> bytes:
    return struct.pack(f"<IiQQ{len(c.params)}d", c.camera_id, c.model_id, c.width, c.height, *c.params)


def _image(i: Image) -> bytes:
    name = i.name if isinstance(i.name, bytes) else i.name.encode()
    head = struct.pack("<I7dI", i.image_id, *i.pose, i.camera_id) + name + b"\0"
    return head + struct.pack("<Q", len(i.points2d)) + b"".join(struct.pack("<ddQ", *p) for p in i.points2d)


def _point(p: Point) -> bytes:
    head = struct.pack("<Q3d3BdQ", p.point_id, *p.xyz, *p.rgb, p.error, len(p.track))
    return head + b"".join(struct.pack("<II", *element) for element in p.track)


def _rig(r: Rig) -> bytes:
    parts = [struct.pack("<II", r.rig_id, len(r.sensors))]
    for position, (kind, sensor_id, pose) in enumerate(r.sensors):
        parts.append(struct.pack("<iI", kind, sensor_id))
        if position:
            parts.append(struct.pack("<B7d", 1, *pose) if pose else b"\0")
    return b"".join(parts)


def _frame(f: Frame) -> bytes:
    head = struct.pack("<II7dI", f.frame_id, f.rig_id, *f.pose, len(f.data))
    return head + b"".join(struct.pack("<iIQ", *element) for element in f.data)


def text_files(model: Model, *, header: bool = True) -> dict[str, bytes]:
    files = {
        "cameras.txt": _lines("cameras", model.cameras, lambda c: _camera_line(model, c), header=header),
        "images.txt": _lines("images", model.images, _image_lines, header=header),
        "points3D.txt": _lines("points", model.points, _point_line, header=header),
    }
    if model.rigs is not None:
        files["rigs.txt"] = _lines("rigs", model.rigs, _rig_line, header=header)
    if model.frames is not None:
        files["frames.txt"] = _lines("frames", model.frames, _frame_line, header=header)
    return files


def _lines(kind: str, records, format_one, *, header: bool) -> bytes:
    comment = f"# A list\n#   SOME, COLUMNS[]\n# Number of {kind}: {len(records)}, mean of something: 1.5\n"
    return ((comment if header else "") + "".join(format_one(record) + "\n" for record in records)).encode()


def _join(*values: object) -> str:
    return " ".join(repr(value) if isinstance(value, float) else str(value) for value in values)


def _camera_line(model: Model, c: Camera) -> str:
    return _join(c.camera_id, model.name_of_model[c.model_id], c.width, c.height, *c.params)


def _image_lines(i: Image) -> str:
    points = [value for x, y, k in i.points2d for value in (x, y, -1 if k == UNLINKED else k)]
    return _join(i.image_id, *i.pose, i.camera_id, i.name) + "\n" + _join(*points)


def _point_line(p: Point) -> str:
    return _join(p.point_id, *p.xyz, *p.rgb, p.error, *(value for element in p.track for value in element))


def _rig_line(r: Rig) -> str:
    values = [r.rig_id, len(r.sensors)]
    for position, (kind, sensor_id, pose) in enumerate(r.sensors):
        values += [SENSOR_NAMES.get(kind, kind), sensor_id]
        if position:
            values += [1, *pose] if pose else [0]
    return _join(*values)


def _frame_line(f: Frame) -> str:
    data = [
        value for kind, sensor_id, data_id in f.data for value in (SENSOR_NAMES.get(kind, kind), sensor_id, data_id)
    ]
    return _join(f.frame_id, f.rig_id, *f.pose, len(f.data), *data)
