r"""VisualSFM: one file ``*.nvm``.

Facts, of VisualSFM's documentation ("NVM file format") and of PBA's ``util.h`` and ``DataInterface.h`` (C. Wu,
Multicore Bundle Adjustment), whose loader and saver VisualSFM uses:

- text: ``NVM_V3`` (what follows on that line, ``FixedK ..``, is a calibration that was given, and repeats the
  cameras'), then models: the number of cameras, one line for each (name, f, quaternion w x y z, centre, radial
  distortion, 0), the number of points, one line for each (position, colour, number of measurements, then image,
  feature, x, y of each). Models follow each other until a number of cameras of 0; behind it stands a list of PLY
  files, which is not read. Names hold no blanks (VisualSFM writes ``"`` for them).
- pose: R from world to camera by the quaternion, which PBA normalises, and C = -R^T t. x right, y down, z forwards.
- x, y are px from the image's centre, which is the principal point.
- the lens works on measurements: with m = (x, y) / f the undistorted point is m (1 + d |m|^2); hence the camera model
  INVERSE_RADIAL. VisualSFM's own residual is f ((X, Y) / Z - m (1 + d |m|^2)), in px of the undistorted image; here
  residuals are observed minus projected in the distorted image, as for all formats: both are 0 together, and differ
  by the derivative of the lens.
- not stored: sizes of images. Every image has a camera of its own.
- several models in one file share no scale; they become one table, with a finding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.foreign.lens import raw_camera
from sfm_audit.loaders.foreign.number_stream import NumberStream, track_rows, unterminated
from sfm_audit.loaders.foreign.one_file import only_file
from sfm_audit.loaders.foreign.rotations import rotate
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, assumed_size, raw_model
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextFile, check_text, parse_floats, parse_uint, read_text, repr_token

PATTERN: Final = "*.nvm"
_ADVICE: Final = "check that this is VisualSFM's file of version 3, or save it again"
_HEADER: Final = b"NVM_V3"


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One model of the file: names, (I, 10) f, quaternion, centre, distortion, 0, (P, 3) points, and its links."""

    names: list[str]
    cameras: FloatArray
    points: FloatArray
    image_idx: IntArray
    point_idx: IntArray
    xy_centred: FloatArray


def read(folder: InputPath) -> RawModel:
    """Read the one file ``*.nvm`` in ``folder``; LoadError where that cannot be done."""
    path = only_file(folder, PATTERN)
    file = read_text(path, _ADVICE)
    parts, is_ended = _parts(file)
    first_image = np.cumsum([0, *(len(part.names) for part in parts)])
    first_point = np.cumsum([0, *(len(part.points) for part in parts)])
    xy_centred = np.concatenate([np.empty((0, 2)), *(part.xy_centred for part in parts)])
    width, height, assumed = assumed_size(xy_centred)
    cameras = np.concatenate([np.empty((0, 10)), *(part.cameras for part in parts)])
    names = [name for part in parts for name in part.names]
    none = np.empty(0, np.int64)
    links = Links(
        np.concatenate([none, *(part.image_idx + first for part, first in zip(parts, first_image, strict=False))]),
        np.concatenate(
            [none, *(part.point_idx + first for part, first in zip(parts, first_point, strict=False))]
        ).astype(np.uint64),
        xy_centred + np.array([width / 2, height / 2]),
    )
    poses = _poses(cameras)
    return raw_model(
        path,
        [_camera(row, cameras[row], (width, height)) for row in range(len(names))],
        [PlacedImage(row, name, row, tuple(poses[row].tolist())) for row, name in enumerate(names)],
        Structure(
            np.arange(int(first_point[-1]), dtype=np.uint64),
            np.concatenate([np.empty((0, 3)), *(part.points for part in parts)]),
        ),
        links,
        findings=(*(() if is_ended else unterminated(file)), *_several(parts), assumed),
    )


def _several(parts: list[_Part]) -> tuple[Finding, ...]:
    if len(parts) < 2:
        return ()
    sizes = ", ".join(str(len(part.names)) for part in parts[:5])
    text = f"the file holds {len(parts)} reconstructions, of {sizes} images; none sees the points of another"
    return (Finding(FindingCode.SEVERAL_RECONSTRUCTIONS, len(parts), text),)


def _poses(cameras: FloatArray) -> FloatArray:
    """Return (I, 7) cam_from_world; the quaternion of length 1, as PBA makes it."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        quats = cameras[:, 1:5] / np.linalg.norm(cameras[:, 1:5], axis=1, keepdims=True)
    return np.hstack([quats, -rotate(quats, cameras[:, 5:8])])


def _camera(row: int, values: FloatArray, size: tuple[int, int]) -> RawCamera:
    focal, distortion = float(values[0]), float(values[8])
    lens = {"fx": focal, "cx": size[0] / 2, "cy": size[1] / 2, "k1": distortion}
    return raw_camera(row, BY_NAME["INVERSE_RADIAL" if distortion != 0 else "SIMPLE_PINHOLE"], size, lens)


def _parts(file: TextFile) -> tuple[list[_Part], bool]:
    """Return the models of the file, and whether a line behind the last of them was reached."""
    lines = [(row, line) for row, line in enumerate(file.lines) if line.strip()]
    if not lines or lines[0][1].split()[0] != _HEADER:
        got = repr_token(lines[0][1].strip()) if lines else "no line"
        raise file.malformed(1, f"{_HEADER.decode()} as the first word", got)
    _check_calibration(file, *lines[0])
    parts: list[_Part] = []
    at = 1
    while True:
        if at == len(lines):
            if not parts:
                raise file.truncated("a number of cameras", "the end of the file")
            return parts, False
        count = _count(file, *lines[at], "a number of cameras")
        if count == 0:
            return parts, True
        part, at = _part(file, lines, at + 1, count)
        parts.append(part)


def _check_calibration(file: TextFile, row: int, line: bytes) -> None:
    """Raise where the file states a calibration with two focal lengths: its measurements are scaled then."""
    words = line.split()[1:]
    if len(words) >= 5 and words[0] == b"FixedK" and words[1] != words[3]:
        raise file.malformed(row + 1, "FixedK with fx = fy", repr_token(b" ".join(words)))


def _count(file: TextFile, row: int, line: bytes, what: str) -> int:
    words = line.split()
    if len(words) != 1:
        raise file.malformed(row + 1, what, repr_token(line.strip()))
    return parse_uint(file, row + 1, words[0], what, bits=31)


def _part(file: TextFile, lines: list[tuple[int, bytes]], at: int, num_cameras: int) -> tuple[_Part, int]:
    """Read the model whose cameras begin at ``lines[at]``; return where the lines go on."""
    if at + num_cameras >= len(lines):
        raise file.truncated(f"{num_cameras} cameras and a number of points", "the end of the file")
    names, cameras = [], np.empty((num_cameras, 10))
    for row in range(num_cameras):
        number, line = lines[at + row]
        words = line.split()
        if len(words) != 11:
            raise file.malformed(number + 1, "NAME F QW QX QY QZ CX CY CZ RADIAL 0", f"{len(words)} values")
        names.append(words[0].decode("utf-8", errors="backslashreplace").replace('"', " "))
        cameras[row] = parse_floats(file, number + 1, words[1:], "a camera")
    num_points = _count(file, *lines[at + num_cameras], "a number of points")
    first = at + num_cameras + 1
    if first + num_points > len(lines):
        raise file.truncated(f"{num_points} points", "the end of the file")
    last = lines[first + num_points - 1][0] + 1 if num_points else lines[first - 1][0] + 1
    stream = NumberStream(file, lines[first][0] if num_points else last, last)
    begins, lengths, views = track_rows(stream, num_points, head=7, width=4)
    if stream.at < len(stream.values):
        raise stream.malformed(stream.at, "the end of a point", f"{len(stream.values) - stream.at} more numbers")
    image_idx = stream.whole(views, num_cameras, "the position of an image")
    xy = np.stack([stream.values[views + 2], stream.values[views + 3]], axis=1).reshape(-1, 2)
    points = stream.values[begins[:, None] + np.arange(3)].reshape(-1, 3)
    return _Part(names, cameras, points, image_idx, np.repeat(np.arange(num_points), lengths), xy), first + num_points


def count_images(folder: InputPath) -> int:
    """Return the number of images of all models; the lines are read, no points are parsed."""
    file = read_text(only_file(folder, PATTERN), _ADVICE)
    lines = [(row, line) for row, line in enumerate(file.lines) if line.strip()]
    if not lines or lines[0][1].split()[0] != _HEADER:
        raise file.malformed(1, f"{_HEADER.decode()} as the first word", "something else")
    total, at = 0, 1
    while at < len(lines) and (count := _count(file, *lines[at], "a number of cameras")):
        total += count
        if at + count + 1 >= len(lines):
            raise file.truncated(f"{count} cameras and a number of points", "the end of the file")
        at += count + 2 + _count(file, *lines[at + count + 1], "a number of points")
    return total


def check(folder: InputPath) -> None:
    """Raise LoadError where the file is no text; nothing behind the first NUL byte is read."""
    check_text(only_file(folder, PATTERN), _ADVICE)


NVM: Final = ModelFormat(name="nvm", required=(PATTERN,), read=read, count_images=count_images, check=check)
