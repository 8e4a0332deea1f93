"""kapture 1.1: ``reconstruction/`` with ``points3d.txt`` and ``observations.txt``, and ``sensors/`` beside it.

Facts, of "kapture format specifications" (naver/kapture, kapture_format.adoc) and of ``kapture/io/csv.py``:

- text, separated by commas, ``#`` begins a comment. The model is the folder ``reconstruction``; sensors, records and
  trajectories stand in ``../sensors``; so kapture is read on this machine only.
- sensors: id, name, type, and of cameras the model, width, height, parameters: COLMAP's models, names and order, and
  with them COLMAP's axes and pixels (``kapture.converter.colmap`` copies both unchanged).
- trajectories: timestamp, device, quaternion w x y z, translation, from world to device; a device is a camera or a
  rig, whose sensors have a pose from rig to sensor each. A pose may lack its numbers: such an image was not placed.
- observations: point, type of keypoints, then image and position of a keypoint, repeated. Points are named by their
  row, from 0.
- keypoints: ``keypoints/<type>/<image>.kpt``, rows of numbers as ``keypoints.txt`` beside it says (name, dtype,
  dsize), x and y first.
- archives of keypoints (``.tar``) and format 1.0 are refused; kapture's own tools convert them.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel, check_camera
from sfm_audit.loaders.assembly.rigs import compose
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.errors import MalformedFileError, MissingFileError, Position
from sfm_audit.loaders.foreign.number_stream import unterminated
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, raw_model
from sfm_audit.loaders.model import Finding
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.files import exists, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextFile, check_text, parse_floats, parse_uint, read_text, repr_token

POINTS: Final = "points3d.txt"
OBSERVATIONS: Final = "observations.txt"
SENSORS: Final = "../sensors/sensors.txt"
RECORDS: Final = "../sensors/records_camera.txt"
TRAJECTORIES: Final = "../sensors/trajectories.txt"
RIGS: Final = "../sensors/rigs.txt"
KEYPOINTS: Final = "keypoints"
_ADVICE: Final = "check that this is kapture's format 1.1, or convert it again"
_NO_CAMERA: Final = 2**32 - 1
_MAX_BYTES: Final = 1 << 30  # of the keypoints of one image
_Pose = tuple[float, ...]


class _Csv:
    """One of kapture's text files."""

    def __init__(self, path: InputPath) -> None:
        self.file: TextFile = read_text(path, _ADVICE, may_be_empty=True)

    def rows(self, least: int) -> Iterator[tuple[int, list[bytes]]]:
        """Yield lines with at least ``least`` fields, without blanks around them."""
        for line, record in self.file.records():
            fields = [field.strip() for field in record.split(b",")]
            if len(fields) < least:
                raise self.file.malformed(line, f"at least {least} fields", f"{len(fields)}")
            yield line, fields

    def pose(self, line: int, fields: list[bytes]) -> _Pose | None:
        """Return the seven numbers of a pose; None where it lacks them."""
        if len(fields) != 7:
            raise self.file.malformed(line, "QW, QX, QY, QZ, TX, TY, TZ", f"{len(fields)} fields")
        if not all(fields):
            return None
        return tuple(parse_floats(self.file, line, fields, "a pose").tolist())


def _text(token: bytes) -> str:
    return token.decode("utf-8", errors="backslashreplace")


def read(folder: InputPath) -> RawModel:
    """Read the reconstruction in ``folder`` with the sensors beside it; LoadError where that cannot be done."""
    files = {name: _Csv(folder / name) for name in (SENSORS, RECORDS, TRAJECTORIES, OBSERVATIONS)}
    cameras, camera_ids = _cameras(files[SENSORS])
    images = _images(files[RECORDS], _poses(files[TRAJECTORIES], folder / RIGS), camera_ids)
    points = read_text(folder / POINTS, _ADVICE)
    xyz = _points(points)
    links, counts = _links(folder, files[OBSERVATIONS], {image.name: row for row, image in enumerate(images)})
    linked = np.bincount(links.image_idx[links.image_idx >= 0], minlength=len(images))
    placed = [
        PlacedImage(i.image_id, i.name, i.camera_id, i.pose, max(0, counts.get(i.name, 0) - int(n)))
        for i, n in zip(images, linked, strict=True)
    ]
    if exists(folder / RIGS):
        files[RIGS] = _Csv(folder / RIGS)
    texts = [each.file for each in files.values()]
    findings: list[Finding] = [finding for text in texts for finding in unterminated(text)]
    structure = Structure(np.arange(len(xyz), dtype=np.uint64), xyz)
    return raw_model(points.path, cameras, placed, structure, links, findings=(*findings, *unterminated(points)))


def _cameras(csv: _Csv) -> tuple[list[RawCamera], dict[bytes, int]]:
    cameras: list[RawCamera] = []
    ids: dict[bytes, int] = {}
    for line, fields in csv.rows(3):
        if fields[2] != b"camera":
            continue
        if fields[0] in ids:
            raise csv.file.malformed(line, "a sensor id that the file has not used before", repr_token(fields[0]))
        model = BY_NAME.get(_text(fields[3])) if len(fields) > 3 else None
        if model is None or not model.is_colmap:
            raise csv.file.malformed(line, "a camera model of COLMAP's", repr_token(b", ".join(fields[3:4])))
        if len(fields) != 6 + model.num_params:
            wanted = f"width, height and {model.num_params} parameters of {model.name}"
            raise csv.file.malformed(line, wanted, f"{len(fields) - 4} values")
        numbers = parse_floats(csv.file, line, fields[4:], "a camera").tolist()
        if not all(0 <= size < 2**32 and size == int(size) for size in numbers[:2]):
            raise csv.file.malformed(line, "a width and a height", repr_token(b", ".join(fields[4:6])))
        ids[fields[0]] = len(cameras)
        camera = RawCamera(len(cameras), model.model_id, int(numbers[0]), int(numbers[1]), tuple(numbers[2:]))
        check_camera(csv.file.path, Position("line", line), camera)
        cameras.append(camera)
    return cameras, ids


def _poses(csv: _Csv, rigs: InputPath) -> dict[tuple[bytes, bytes], _Pose]:
    """Return cam_from_world by timestamp and camera, those that rigs place included."""
    poses: dict[tuple[bytes, bytes], _Pose] = {}
    for line, fields in csv.rows(2):
        pose = csv.pose(line, fields[2:])
        if pose is not None:
            poses[fields[0], fields[1]] = pose
    if not exists(rigs):
        return poses
    sensors: dict[bytes, list[tuple[bytes, _Pose]]] = {}
    rig_csv = _Csv(rigs)
    for line, fields in rig_csv.rows(2):
        pose = rig_csv.pose(line, fields[2:])
        if pose is not None:
            sensors.setdefault(fields[0], []).append((fields[1], pose))
    for (timestamp, device), rig_from_world in list(poses.items()):
        for sensor, cam_from_rig in sensors.get(device, []):
            with np.errstate(over="ignore", invalid="ignore"):
                composed = compose(np.array([cam_from_rig]), np.array([rig_from_world]))[0]
            poses.setdefault((timestamp, sensor), tuple(composed.tolist()))
    return poses


def _images(csv: _Csv, poses: dict[tuple[bytes, bytes], _Pose], camera_ids: dict[bytes, int]) -> list[PlacedImage]:
    images: list[PlacedImage] = []
    seen: set[bytes] = set()
    for line, fields in csv.rows(3):
        timestamp, device, name = fields[0], fields[1], b",".join(fields[2:])
        if name in seen:
            raise csv.file.malformed(line, "an image that the file has not named before", repr_token(name))
        seen.add(name)
        pose = poses.get((timestamp, device))
        if pose is not None:
            images.append(PlacedImage(len(seen) - 1, _text(name), camera_ids.get(device, _NO_CAMERA), pose))
    return images


def _points(file: TextFile) -> FloatArray:
    rows = []
    for line, record in file.records():
        fields = record.split(b",")
        if len(fields) not in {3, 6}:
            raise file.malformed(line, "X, Y, Z[, R, G, B]", f"{len(fields)} fields")
        rows.append(parse_floats(file, line, [field.strip() for field in fields[:3]], "a point"))
    return np.array(rows).reshape(-1, 3)


def _links(folder: InputPath, csv: _Csv, row_of: dict[str, int]) -> tuple[Links, dict[str, int]]:
    """Return the observations, and how many keypoints each image that is observed has."""
    if any(b"kapture format: 1.0" in line for line in csv.file.lines[:1]):
        raise csv.file.malformed(1, "kapture format: 1.1", "1.0")
    keypoints = _Keypoints(folder)
    image_idx: list[int] = []
    point_ids: list[int] = []
    xy: list[FloatArray] = []
    for line, fields in csv.rows(2):
        point_id = parse_uint(csv.file, line, fields[0], "a point's row", bits=63)
        if len(fields) % 2:
            raise csv.file.malformed(line, "POINT, TYPE, [IMAGE, KEYPOINT]", f"{len(fields)} fields")
        for image, at in zip(fields[2::2], fields[3::2], strict=True):
            name = _text(image)
            row = row_of.get(name, -1)
            position = parse_uint(csv.file, line, at, "a keypoint's position")
            image_idx.append(row)
            point_ids.append(point_id)
            found = keypoints.of(fields[1], image) if row >= 0 else _NOWHERE
            if row >= 0 and position >= len(found):
                raise csv.file.malformed(line, f"a keypoint below {len(found)} of {name[:80]}", f"{position}")
            xy.append(found[position] if row >= 0 else _NOWHERE[0])
    links = Links(
        np.array(image_idx, np.int64), np.array(point_ids, np.uint64), np.array(xy, np.float64).reshape(-1, 2)
    )
    return links, keypoints.counts


_NOWHERE: Final = np.zeros((1, 2))


class _Keypoints:
    """The files of keypoints, each read once, when an observation names it."""

    def __init__(self, folder: InputPath) -> None:
        self._folder = folder / KEYPOINTS
        self._types: dict[bytes, tuple[np.dtype[np.floating[Any]], int]] = {}
        self._found: dict[tuple[bytes, bytes], FloatArray] = {}
        self.counts: dict[str, int] = {}

    def of(self, kind: bytes, image: bytes) -> FloatArray:
        """Return (n, 2) px of an image."""
        if (kind, image) not in self._found:
            if kind not in self._types:
                self._types[kind] = self._type(kind)
            self._found[kind, image] = self._read(kind, image)
            name = _text(image)
            self.counts[name] = self.counts.get(name, 0) + len(self._found[kind, image])
        return self._found[kind, image]

    def _below(self, *names: bytes) -> InputPath:
        path = self._folder
        for name in names:
            for part in _text(name).split("/"):
                if part in {"", ".", ".."} or "\\" in part or ":" in part or "\0" in part:
                    wanted = "names of images and keypoints inside the folder"
                    raise MalformedFileError(str(self._folder), None, wanted, repr_token(name), _ADVICE)
                path = path / part
        return path

    def _type(self, kind: bytes) -> tuple[np.dtype[np.floating[Any]], int]:
        folder = self._below(kind)
        if not exists(folder / "keypoints.txt") and exists(folder / "keypoints.tar"):
            raise MissingFileError(str(folder), None, "keypoints in files", "keypoints.tar", "unpack it")
        csv = _Csv(folder / "keypoints.txt")
        line, fields = next(csv.rows(3), (1, [b"", b"", b""]))
        dtype = fields[1].removeprefix(b"<class 'numpy.").removesuffix(b"'>")
        if dtype not in {b"float32", b"float64", b"float"}:
            raise csv.file.malformed(line, "the dtype float32 or float64", repr_token(fields[1]))
        dsize = parse_uint(csv.file, line, fields[2], "a number of values per keypoint", bits=16)
        if dsize < 2:
            raise csv.file.malformed(line, "at least 2 values per keypoint", f"{dsize}")
        return np.dtype("<f4" if dtype == b"float32" else "<f8"), dsize

    def _read(self, kind: bytes, image: bytes) -> FloatArray:
        dtype, dsize = self._types[kind]
        path = self._below(kind, image + b".kpt")
        file, size = _open_keypoints(path)
        with file, reading(path):
            content = file.read(min(size, _MAX_BYTES))
        if len(content) % (dtype.itemsize * dsize):
            wanted = f"rows of {dsize} numbers of {dtype.itemsize} bytes"
            raise MalformedFileError(str(path), Position("byte", size), wanted, f"{len(content)} bytes", _ADVICE)
        return np.frombuffer(content, dtype).reshape(-1, dsize)[:, :2].astype(np.float64)


def _open_keypoints(path: InputPath) -> tuple[BufferedReader, int]:
    file, size = open_input(path, may_be_empty=True)
    if size > _MAX_BYTES:
        file.close()
        raise MalformedFileError(str(path), None, f"at most {_MAX_BYTES} bytes of keypoints", f"{size}", _ADVICE)
    return file, size


def check(folder: InputPath) -> None:
    """Raise LoadError where a file of text is none, or one of keypoints too large."""
    for name in (POINTS, OBSERVATIONS, SENSORS, RECORDS, TRAJECTORIES):
        check_text(folder / name, _ADVICE, may_be_empty=True)
    for name in KAPTURE.below(folder) if isinstance(folder, Path) else ():
        _open_keypoints(folder / name)[0].close()


def count_images(folder: InputPath) -> int:
    """Return the number of images that were recorded, those without a pose included."""
    return sum(1 for _ in _Csv(folder / RECORDS).rows(3))


KAPTURE: Final = ModelFormat(
    name="kapture",
    required=(POINTS, OBSERVATIONS),
    optional=(SENSORS, RECORDS, TRAJECTORIES, RIGS),
    folders=(KEYPOINTS,),
    read=read,
    count_images=count_images,
    check=check,
)
