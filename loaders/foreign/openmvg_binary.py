r"""OpenMVG: ``sfm_data.bin``, what its programs write by default; the same content as `openmvg`'s JSON.

Facts, of ``src/openMVG/sfm/sfm_data_io_cereal.cpp`` and the ``*_io.hpp`` beside it and in ``cameras`` and ``geometry``
(version 2.1), beyond those of `openmvg` and of cereal (`portable_binary`):

- version and root path (strings), then maps by a key of 32 bits: views, intrinsics, extrinsics, structure, and from
  version 0.2 on control points, which are stored like structure.
- view: folder and file name, then width, height, its id, the intrinsic's and the pose's, 32 bits each; behind a
  pointer, which has a kind from version 0.3 on: ``view_priors`` adds a byte 1 and two vectors of three (weight and
  centre) where the view has a prior, and nothing at all where it has none.
- intrinsic: a pointer with a kind; width and height (32 bits), focal length, principal point (a vector of two), and
  a vector of coefficients unless it is ``pinhole``.
- extrinsics: rotation (three vectors of three), centre (a vector of three).
- structure: position (a vector of three), then a map from views to the number of a feature (32 bits) and a vector of
  two: 32 bytes per observation.

Where both files lie in a folder this one is read: the JSON is converted from it, and often without structure.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfm_audit.loaders.arrays import FloatArray, IntArray, UInt64Array
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.foreign.openmvg import COEFFICIENTS, Poses, View, camera, placed_images
from sfm_audit.loaders.foreign.portable_binary import PortableBinary
from sfm_audit.loaders.foreign.tables import Links, Structure, raw_model
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

FILE: Final = "sfm_data.bin"
_ADVICE: Final = "write OpenMVG's sfm_data.bin again, or convert it (openMVG_main_ConvertSfM_DataFormat)"
_PIECE: Final = 1 << 20  # of the observations of one point, 32 bytes each
_LEAST_VIEW: Final = 44
_LEAST_CAMERA: Final = 44
_POSE_BYTES: Final = 140
_LANDMARK: Final = "IQ3dQ"
_PRIOR: Final = "BQ3dQ3d"
_VERSIONS: Final = ("0.1", "0.2", "0.3")
_T = TypeVar("_T")


class _Landmarks(NamedTuple):
    """keys: (P,).    xyz: (P, 3).    lengths: (P,).    view_ids: (M,).    xy: (M, 2)."""

    keys: UInt64Array
    xyz: FloatArray
    lengths: IntArray
    view_ids: IntArray
    xy: FloatArray


def read(folder: InputPath) -> RawModel:
    """Read ``sfm_data.bin``; LoadError where that cannot be done."""
    path = folder / FILE
    file, size = open_input(path)
    with file, reading(path):
        return _read(PortableBinary(path, file, size, _ADVICE))


def _read(archive: PortableBinary) -> RawModel:
    version = _head(archive)
    views = _map(archive, "views", _LEAST_VIEW, _Views(archive, has_kinds=version == "0.3").read)
    cameras = _map(archive, "intrinsics", _LEAST_CAMERA, _Cameras(archive).read)
    poses = _map(archive, "poses", _POSE_BYTES, lambda key: (key, archive.matrix("a rotation"), _centre(archive)))
    found = _landmarks(archive, "3D points")
    if version != "0.1":
        _landmarks(archive, "control points")
    archive.finish("its last part")
    pose_table = Poses(
        [key for key, _, _ in poses],
        np.array([matrix for _, matrix, _ in poses]).reshape(-1, 3, 3),
        np.array([centre for _, _, centre in poses], np.float64).reshape(-1, 3),
    )
    images, findings = placed_images(archive.path, views, pose_table)
    rows = np.array([image.image_id for image in images], np.int64)
    structure = Structure(found.keys, found.xyz)
    links = Links(_rows_of(found.view_ids, rows), np.repeat(found.keys, found.lengths), found.xy)
    return raw_model(archive.path, cameras, images, structure, links, findings=findings)


def _rows_of(view_ids: IntArray, image_ids: IntArray) -> IntArray:
    """Return the row in ``image_ids`` of every view, -1 where it has none."""
    if not len(image_ids):
        return np.full(len(view_ids), -1, np.int64)
    order = np.argsort(image_ids)
    at = np.minimum(np.searchsorted(image_ids, view_ids, sorter=order), len(image_ids) - 1)
    return np.where(image_ids[order[at]] == view_ids, order[at], -1).astype(np.int64)


def _head(archive: PortableBinary) -> str:
    at, version = archive.at, archive.text("the version")
    if version not in _VERSIONS:
        raise archive.malformed(at, f"a version that is read ({', '.join(_VERSIONS)})", f"{version!r:.40}")
    archive.text("the root path")
    return version


def _centre(archive: PortableBinary) -> tuple[float, ...]:
    return archive.vector(3, "a centre")


def _map(archive: PortableBinary, what: str, least_bytes: int, read_one: Callable[[int], _T]) -> list[_T]:
    """Return the values of a map, each made from its key; MalformedFileError for a key that comes twice."""
    seen: set[int] = set()
    found = []
    for _ in range(archive.count(what, least_bytes)):
        at, key = archive.at, archive.whole("I", f"a key of {what}")
        if key in seen:
            raise archive.malformed(at, f"a key of {what} that was not used before", f"{key} again")
        seen.add(key)
        found.append(read_one(key))
    return found


class _Views:
    """Reads views; one may stand for another's pointer."""

    def __init__(self, archive: PortableBinary, *, has_kinds: bool) -> None:
        self._archive = archive
        self._has_kinds = has_kinds
        self._known: dict[int, View] = {}

    def read(self, key: int) -> View:
        archive, at = self._archive, self._archive.at
        kind = archive.kind("view", "a view") if self._has_kinds else "view"
        if kind not in {"view", "view_priors"}:
            raise archive.malformed(at, "a view of the kind view or view_priors", f"{kind!r:.40}")
        number, follows = archive.pointer("a view")
        if not follows:
            if number not in self._known:
                raise archive.malformed(at, "a view, or the number of one before it", f"{number}")
            return self._known[number]._replace(view_id=key)
        folder, name = archive.text("a folder"), archive.text("a file name")
        _, _, _, camera_id, pose_id = (int(value) for value in archive.take("5I", "a view"))
        if kind == "view_priors":
            self._skip_prior()
        self._known[number] = View(key, folder, name, camera_id, pose_id)
        return self._known[number]

    def _skip_prior(self) -> None:
        """Step over a prior where there is one: 1, and twice a size of 3 and three numbers."""
        archive = self._archive
        layout = struct.Struct(archive.order + _PRIOR)
        ahead = archive.peek(layout.size)
        if len(ahead) == layout.size:
            fields = layout.unpack(ahead)
            if (fields[0], fields[1], fields[5]) == (1, 3, 3):
                archive.take(_PRIOR, "a prior")


class _Cameras:
    """Reads intrinsics; one may stand for another's pointer."""

    def __init__(self, archive: PortableBinary) -> None:
        self._archive = archive
        self._known: dict[int, RawCamera] = {}

    def read(self, key: int) -> RawCamera:
        archive, at = self._archive, self._archive.at
        kind = archive.kind("", "an intrinsic")
        if kind not in COEFFICIENTS:
            raise archive.malformed(at, f"a camera that is read ({', '.join(COEFFICIENTS)})", f"{kind!r:.40}")
        number, follows = archive.pointer("an intrinsic")
        if not follows:
            if number not in self._known:
                raise archive.malformed(at, "an intrinsic, or the number of one before it", f"{number}")
            return replace(self._known[number], camera_id=key)
        width, height, focal = archive.take("IId", "an intrinsic")
        params = [focal, *archive.vector(2, "a principal point")]
        names = COEFFICIENTS[kind][1]
        if names:
            params += archive.vector(len(names), f"the coefficients of {kind}")
        self._known[number] = camera(key, kind, (int(width), int(height)), params)
        return self._known[number]


def _landmarks(archive: PortableBinary, what: str) -> _Landmarks:
    """Return points with their observations."""
    order = archive.order
    layout = struct.Struct(order + _LANDMARK)
    seen_as = np.dtype(
        [("view", order + "u4"), ("unused", order + "u4"), ("size", order + "u8"), ("x", order + "f8", 2)]
    )
    count = archive.count(what, layout.size)
    heads, parts, starts = [], [], []
    for row in range(count):
        at = archive.at
        head = layout.unpack(archive.read(layout.size, f"point {row + 1} of {count} {what}"))
        if head[1] != 3:
            raise archive.malformed(at + 4, "3 coordinates of a point", f"{head[1]}")
        num_bytes = head[5] * seen_as.itemsize
        if num_bytes > archive.num_left:
            wanted = f"{head[5]} observations, at least {num_bytes} bytes"
            raise archive.truncated(archive.at - 8, wanted, archive.num_left)
        heads.append((head[0], *head[2:]))
        starts.append(archive.at)
        while num_bytes > 0:
            parts.append(archive.read(min(num_bytes, _PIECE), "observations"))
            num_bytes -= len(parts[-1])
            if len(parts[-1]) == _PIECE:  # zeros without end are refused before they fill the memory
                _check_sizes(archive, np.frombuffer(parts[-1], seen_as), np.array([archive.at - _PIECE]), None)
    table = np.array(heads, np.float64).reshape(-1, 5)
    lengths = table[:, 4].astype(np.int64)
    found = np.frombuffer(b"".join(parts), seen_as)
    _check_sizes(archive, found, np.array(starts, np.int64), lengths)
    xy, views = found["x"].astype(np.float64).reshape(-1, 2), found["view"].astype(np.int64)
    return _Landmarks(table[:, 0].astype(np.uint64), table[:, 1:4].copy(), lengths, views, xy)


def _check_sizes(archive: PortableBinary, found: NDArray[np.void], starts: IntArray, lengths: IntArray | None) -> None:
    """Raise where an observation has not two coordinates; ``starts``: bytes at which runs of ``lengths`` begin."""
    wrong = np.flatnonzero(found["size"] != 2)
    if len(wrong):
        row = int(wrong[0])
        ends = np.array([len(found)]) if lengths is None else np.cumsum(lengths)
        run = int(np.searchsorted(ends, row, side="right"))
        at = int(starts[run]) + found.itemsize * (row - (int(ends[run - 1]) if run else 0))
        raise archive.malformed(at + 8, "2 coordinates of an observation", f"{found['size'][row]}")


def count_images(folder: InputPath) -> int:
    """Return the number of views that the head states, those without a pose included."""
    path = folder / FILE
    file, size = open_input(path, only_head=True)
    with file, reading(path):
        archive = PortableBinary(path, file, size, _ADVICE)
        _head(archive)
        return archive.whole("Q", "a number of views")


def check(folder: InputPath) -> None:
    """Raise LoadError where the records do not fill the file."""
    read(folder)


OPENMVG_BINARY: Final = ModelFormat(
    name="openmvg_binary", required=(FILE,), read=read, count_images=count_images, check=check
)
