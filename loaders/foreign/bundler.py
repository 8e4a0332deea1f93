r"""Bundler: ``bundle.out``, with the names of the images in ``list.txt`` where that lies beside it.

Facts, of the manual of Bundler v0.3 ("Output format and scene representation"):

- text: ``# Bundle file v0.3``, the numbers of cameras and points; per camera f k1 k2, R (3 x 3, by rows), t; per
  point its position, colour, and the list of views: their number, then camera, key, x, y of each.
- pose: P = R X + t from world to camera; the camera looks along -z, x right, y up. Here: y and z change their signs.
- p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, px; origin in the image's centre, y up; the corners are
  (+-w / 2, +-h / 2), so the principal point is the centre, wherever a pixel's own centre lies. Residuals are observed
  minus p'.
- not stored: the images' sizes and, in this file, their names. Every image has a camera of its own.
- a camera that was not reconstructed is all zeros; it is no image here.
- observations name cameras by their position, from 0; the key is a position in a file of keypoints that is not read.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.foreign.lens import camera_of
from sfm_audit.loaders.foreign.number_stream import NumberStream, track_rows, unterminated
from sfm_audit.loaders.foreign.rotations import quats_from_matrices
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, assumed_size, raw_model
from sfm_audit.loaders.model import Finding
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.files import exists, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import check_text, is_number, read_text, repr_token

FILE: Final = "bundle.out"
LISTS: Final = ("list.txt", "bundle.list.txt")
_HEADER: Final = b"# Bundle file v0.3"
_HEAD_BYTES: Final = 4096
_ADVICE: Final = "check that this is Bundler's output of version 0.3, or export the reconstruction again"
FLIP: Final = np.array([1.0, -1.0, -1.0])
"""From axes x right, y up, z backwards to x right, y down, z forwards."""


def read(folder: InputPath) -> RawModel:
    """Read ``bundle.out`` and the list of names; LoadError where that cannot be done."""
    path = folder / FILE
    stream = _numbers(path)
    num_cameras, num_points = stream.count("a number of cameras"), stream.count("a number of points")
    cameras = stream.take(15 * num_cameras, f"{num_cameras} cameras").reshape(-1, 15)
    begins, lengths, views = track_rows(stream, num_points, head=7, width=4)
    findings = list(stream.end())
    camera_idx = stream.whole(views, num_cameras, "the position of a camera")
    xy_up = np.stack([stream.values[views + 2], stream.values[views + 3]], axis=1).reshape(-1, 2)
    width, height, assumed = assumed_size(xy_up)
    names, more = _names(folder, num_cameras)
    is_placed = (cameras != 0).any(axis=1)
    image_idx = np.where(is_placed, np.cumsum(is_placed) - 1, -1)
    rows = np.flatnonzero(is_placed).tolist()
    placed = [names[row] for row in rows]
    quats, rotated = quats_from_matrices(path, cameras[is_placed, 3:12].reshape(-1, 3, 3) * FLIP[:, None], placed)
    poses = np.hstack([quats, cameras[is_placed, 12:] * FLIP])
    points = stream.values[begins[:, None] + np.arange(3)]
    return raw_model(
        path,
        [centred_camera(row, cameras[row, :3], (width, height)) for row in rows],
        [PlacedImage(row, names[row], row, tuple(pose.tolist())) for row, pose in zip(rows, poses, strict=True)],
        Structure(np.arange(num_points, dtype=np.uint64), points),
        Links(
            image_idx[camera_idx],
            np.repeat(np.arange(num_points), lengths).astype(np.uint64),
            xy_up * np.array([1.0, -1.0]) + np.array([width / 2, height / 2]),
        ),
        findings=(*findings, *more, *rotated, assumed),
    )


def centred_camera(camera_id: int, values: FloatArray, size: tuple[int, int]) -> RawCamera:
    """Return the camera of one image: ``values`` f, k1, k2, the principal point in its centre."""
    focal, k1, k2 = values.tolist()
    lens = {"fx": focal, "cx": size[0] / 2, "cy": size[1] / 2, "k1": k1, "k2": k2}
    return camera_of(camera_id, size, lens)


def _numbers(path: InputPath) -> NumberStream:
    """Return the numbers behind the head, which is checked."""
    file = read_text(path, _ADVICE)
    line, head = next(((row, line) for row, line in enumerate(file.lines) if line.strip()), (0, b""))
    if head.strip() != _HEADER:
        raise file.malformed(line + 1, f"{_HEADER.decode()} as the first line", repr_token(head.strip()))
    return NumberStream(file, first=line + 1)


def _names(folder: InputPath, count: int) -> tuple[list[str], tuple[Finding, ...]]:
    """Return what the cameras are called: the first word of the lines of a list, or their positions."""
    path = next((folder / name for name in LISTS if exists(folder / name)), None)
    if path is None:
        return [f"image {row}" for row in range(count)], ()
    file = read_text(path, _ADVICE)
    names = [_name(line).decode("utf-8", errors="backslashreplace") for line in file.lines if line.strip()]
    if len(names) != count:
        raise file.truncated(f"{count} names, as many as {FILE} has cameras", f"{len(names)}")
    return names, unterminated(file)


def _name(line: bytes) -> bytes:
    """Return the name in a line of ``list.txt``: what stands before a flag 0 and a focal length, if they are there."""
    words = line.strip().rsplit(None, 2)
    has_focal = len(words) == 3 and words[1] == b"0" and is_number(words[2])
    return words[0] if has_focal else line.strip()


def count_images(folder: InputPath) -> int:
    """Return the number of cameras that the head states, those that were not reconstructed included."""
    path = folder / FILE
    file, _ = open_input(path, only_head=True)
    with file, reading(path):
        lines = [line for line in file.read(_HEAD_BYTES).split(b"\n") if line.strip()]
    words = lines[1].split() if len(lines) > 1 and lines[0].strip() == _HEADER else []
    if not words or not words[0].isdigit() or len(words[0]) > 9:
        raise MalformedFileError(str(path), None, f"{_HEADER.decode()} and a number of cameras", "neither", _ADVICE)
    return int(words[0])


def check(folder: InputPath) -> None:
    """Raise LoadError where a file is no text; nothing behind the first NUL byte is read."""
    for name in (FILE, *LISTS):
        if exists(folder / name):
            check_text(folder / name, _ADVICE)


BUNDLER: Final = ModelFormat(
    name="bundler", required=(FILE,), optional=LISTS, read=read, count_images=count_images, check=check
)
