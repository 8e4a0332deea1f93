r"""BAL, "Bundle Adjustment in the Large": ``problem-*.txt``.

Facts, of the data sets' page (Agarwal, Snavely, Seitz, Szeliski, ECCV 2010) and of Ceres' ``examples/bal_problem.cc``:

- text: the numbers of cameras, points and observations; per observation camera, point, x, y; then 9 numbers per camera
  (rotation vector, t, f, k1, k2), then 3 per point. All ids are positions, from 0.
- camera, axes, lens and residuals are Bundler's: P = R X + t, p = -P / P_z, f (1 + k1 |p|^2 + k2 |p|^4) p, origin in
  the image's centre, y up.
- not stored: names and sizes of images, colours. Every image has a camera of its own.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.foreign.bundler import FLIP, centred_camera
from sfm_audit.loaders.foreign.number_stream import NumberStream
from sfm_audit.loaders.foreign.one_file import only_file
from sfm_audit.loaders.foreign.rotations import quats_from_vectors
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, assumed_size, raw_model
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import check_text, read_text

PATTERN: Final = "problem-*.txt"
_ADVICE: Final = "check that this is a problem of Bundle Adjustment in the Large, or download it again"
_HEAD_BYTES: Final = 4096


def read(folder: InputPath) -> RawModel:
    """Read the one problem in ``folder``; LoadError where that cannot be done."""
    path = only_file(folder, PATTERN)
    stream = NumberStream(read_text(path, _ADVICE))
    num_cameras, num_points = stream.count("a number of cameras"), stream.count("a number of points")
    num_links = stream.count("a number of observations")
    start = stream.at
    links = stream.take(4 * num_links, f"{num_links} observations").reshape(-1, 4)
    cameras = stream.take(9 * num_cameras, f"{num_cameras} cameras").reshape(-1, 9)
    points = stream.take(3 * num_points, f"{num_points} points").reshape(-1, 3)
    findings = stream.end()
    rows = start + 4 * np.arange(num_links, dtype=np.int64)
    camera_idx = stream.whole(rows, num_cameras, "the position of a camera")
    point_idx = stream.whole(rows + 1, num_points, "the position of a point")
    width, height, assumed = assumed_size(links[:, 2:])
    poses = np.hstack([_turned(quats_from_vectors(cameras[:, :3])), cameras[:, 3:6] * FLIP])
    return raw_model(
        path,
        [centred_camera(row, cameras[row, 6:], (width, height)) for row in range(num_cameras)],
        [PlacedImage(row, f"image {row}", row, tuple(poses[row].tolist())) for row in range(num_cameras)],
        Structure(np.arange(num_points, dtype=np.uint64), points),
        Links(
            camera_idx,
            point_idx.astype(np.uint64),
            links[:, 2:] * np.array([1.0, -1.0]) + np.array([width / 2, height / 2]),
        ),
        findings=(*findings, assumed),
    )


def _turned(quats: FloatArray) -> FloatArray:
    """Return half a turn about x times each rotation, w >= 0: the quaternion (0, 1, 0, 0) times (w, x, y, z)."""
    w, x, y, z = quats.T
    turned = np.stack([-x, w, -z, y], axis=1)
    result: FloatArray = np.where(turned[:, :1] < 0, -turned, turned)
    return result


def count_images(folder: InputPath) -> int:
    """Return the number of cameras that the head states."""
    path = only_file(folder, PATTERN)
    file, _ = open_input(path, only_head=True)
    with file, reading(path):
        words = file.read(_HEAD_BYTES).split(maxsplit=3)[:3]
    if len(words) < 3 or not all(word.isdigit() and len(word) < 10 for word in words):
        wanted = "the numbers of cameras, points and observations"
        raise MalformedFileError(str(path), None, wanted, "something else", _ADVICE)
    return int(words[0])


def check(folder: InputPath) -> None:
    """Raise LoadError where the file is no text; nothing behind the first NUL byte is read."""
    check_text(only_file(folder, PATTERN), _ADVICE)


BAL: Final = ModelFormat(name="bal", required=(PATTERN,), read=read, count_images=count_images, check=check)
