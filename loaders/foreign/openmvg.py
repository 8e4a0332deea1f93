r"""OpenMVG: ``sfm_data.json`` with structure; what its ``sfm_data.bin`` says differently stands in `openmvg_binary`.

Facts, of OpenMVG's documentation ("SfM_Data format") and of ``src/openMVG/sfm/*_io.hpp``, ``src/openMVG/cameras`` and
``src/openMVG/geometry/pose3.hpp`` (version 2.1):

- JSON as cereal writes it: views, intrinsics, extrinsics and structure are arrays of ``{key, value}``. Objects behind
  pointers stand in ``value.ptr_wrapper.data``; the name of a camera's kind stands at its first use only, together
  with a number (its highest bit set) by which later ones name it. Some versions wrap what a base class writes in
  ``value0``.
- pose: rotation R (rows) and centre C, camera from world X_cam = R (X - C); x right, y down, z forwards. A view
  without a pose, or without an intrinsic, was not reconstructed (id 4294967295, or an id that the file does not
  have). Views may share a pose.
- image points are px as the detector gave them, and so is the principal point; no file says where the first pixel's
  centre is, and nothing depends on it but the position of the image's border. They are taken as they stand.
- lenses: pinhole; pinhole_radial_k1, pinhole_radial_k3 (k1, k2, k3); pinhole_brown_t2 (k1, k2, k3, t1, t2: OpenCV's
  p1, p2); fisheye (OpenCV's, k1 .. k4). One focal length. Residuals are observed minus projected, px. ``spherical``
  is refused: versions differ in the sign of its latitude.
- observations name views by id, in 3D points; of a view without a pose they are counted and left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.foreign.json_file import JsonPlace, check_size, read_json, rows
from sfm_audit.loaders.foreign.lens import camera_of
from sfm_audit.loaders.foreign.rotations import quats_from_matrices, rotate
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, raw_model
from sfm_audit.loaders.model import Finding
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.locations import InputPath

FILE: Final = "sfm_data.json"
_ADVICE: Final = (
    "check that this is OpenMVG's sfm_data.json with structure (openMVG_main_ConvertSfM_DataFormat writes it)"
)
_NEW: Final = 0x80000000
_NONE: Final = 2**32 - 1
COEFFICIENTS: Final = {
    "pinhole": ("", ()),
    "pinhole_radial_k1": ("disto_k1", ("k1",)),
    "pinhole_radial_k3": ("disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("disto_t2", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""Where each kind of camera keeps its coefficients, and what they are called here."""


class View(NamedTuple):
    """One photo as the file names it, placed or not."""

    view_id: int
    folder: str
    name: str
    camera_id: int
    pose_id: int


class Poses(NamedTuple):
    """All poses of a file. pose_id: n.    matrices: (n, 3, 3) cam from world.    centres: (n, 3), world."""

    pose_id: Sequence[int]
    matrices: FloatArray
    centres: FloatArray


def read(folder: InputPath) -> RawModel:
    """Read ``sfm_data.json``; LoadError where that cannot be done."""
    path = folder / FILE
    top = JsonPlace(path, _ADVICE, read_json(path, _ADVICE))
    cameras = _cameras(top.get("intrinsics"))
    images, findings = _images(top)
    structure = top.get("structure")
    keys, points = _entries(structure)
    xyz = rows(structure, [point.get("X").value for point in points], 3)
    view_ids: list[int] = []
    xy: list[Any] = []
    lengths = []
    for point in points:
        seen = point.get("observations")
        entries = seen.items()
        lengths.append(len(entries))
        for entry in entries:
            try:
                view_ids.append(entry["key"])
                xy.append(entry["value"]["x"])
            except (KeyError, TypeError, IndexError):
                raise seen.malformed("observations with key and value.x", f"{entry!r:.60}") from None
    return raw_model(
        path,
        cameras,
        images,
        Structure(np.array(keys, np.uint64), xyz),
        Links(
            _image_rows(structure, view_ids, images),
            np.repeat(np.array(keys, np.uint64), lengths),
            rows(structure, xy, 2),
        ),
        findings=findings,
    )


def _image_rows(structure: JsonPlace, view_ids: Sequence[Any], images: Sequence[PlacedImage]) -> IntArray:
    row_of = {image.image_id: row for row, image in enumerate(images)}
    if not all(type(view_id) is int for view_id in view_ids):
        wrong = next(view_id for view_id in view_ids if type(view_id) is not int)
        raise structure.malformed("ids of views", f"{wrong!r:.60}")
    return np.array([row_of.get(view_id, -1) for view_id in view_ids], np.int64)


def _entries(place: JsonPlace) -> tuple[list[int], list[JsonPlace]]:
    """Return keys and values of cereal's map; MalformedFileError for a key that comes twice."""
    keys, values = [], []
    seen: set[int] = set()
    for row, value in enumerate(place.items()):
        entry = place.at(row, value)
        key = entry.get("key").whole()
        if key in seen:
            raise entry.malformed("a key that was not used before", f"{key} again")
        seen.add(key)
        keys.append(key)
        values.append(entry.get("value"))
    return keys, values


class _Pointers:
    """Objects behind cereal's pointers, and names of their kinds: each is written once, and named by number later."""

    def __init__(self) -> None:
        self._data: dict[int, JsonPlace] = {}
        self._names: dict[int, str] = {}

    def data_of(self, value: JsonPlace) -> JsonPlace:
        """Return the place of the object itself."""
        wrapper = value.get("ptr_wrapper")
        number = wrapper.get("id").whole() if "id" in wrapper.objects() else None
        if "data" in wrapper.objects():
            data = wrapper.get("data")
            if number is not None:
                self._data[number & ~_NEW] = data
            return data
        if number is None or number not in self._data:
            raise wrapper.malformed("an object, or the id of one before it", "neither")
        return self._data[number]

    def name_of(self, value: JsonPlace) -> str:
        """Return what the object's kind is called."""
        number = value.get("polymorphic_id").whole() if "polymorphic_id" in value.objects() else 0
        if "polymorphic_name" in value.objects():
            self._names[number & ~_NEW] = value.get("polymorphic_name").text()
        name = self._names.get(number & ~_NEW)
        if name is None:
            raise value.malformed("a polymorphic_name, or the id of one before it", f"id {number}")
        return name


def _field(data: JsonPlace, key: str) -> JsonPlace:
    """Return a value of an object or of its base class."""
    holder = data.get("value0") if key not in data.objects() and "value0" in data.objects() else data
    return holder.get(key)


def _cameras(place: JsonPlace) -> list[RawCamera]:
    pointers = _Pointers()
    found = []
    for camera_id, value in zip(*_entries(place), strict=True):
        kind, data = pointers.name_of(value), pointers.data_of(value)
        if kind not in COEFFICIENTS:
            raise value.malformed(f"a camera that is read ({', '.join(COEFFICIENTS)})", f"{kind!r:.40}")
        size = _field(data, "width").whole(), _field(data, "height").whole()
        centre = _field(data, "principal_point").numbers(2)
        focal = _field(data, "focal_length").number()
        key, names = COEFFICIENTS[kind]
        coefficients = _field(data, key).numbers(len(names)) if names else []
        found.append(camera(camera_id, kind, size, (focal, *centre, *coefficients)))
    return found


def camera(camera_id: int, kind: str, size: tuple[int, int], params: Sequence[float]) -> RawCamera:
    """Return a camera of a kind of `COEFFICIENTS`; ``params``: f, cx, cy and its coefficients."""
    values = dict(zip(("fx", "cx", "cy", *COEFFICIENTS[kind][1]), params, strict=True))
    return camera_of(camera_id, size, values, is_fisheye=kind == "fisheye")


def _images(top: JsonPlace) -> tuple[list[PlacedImage], tuple[Finding, ...]]:
    """Return the views that have a pose and an intrinsic."""
    extrinsics = top.get("extrinsics")
    pose_ids, poses = _entries(extrinsics)
    matrices = [rows(pose, pose.get("rotation").items(), 3) for pose in poses]
    for pose, matrix in zip(poses, matrices, strict=True):
        if matrix.shape != (3, 3):
            raise pose.malformed("a rotation of 3 rows", f"{len(matrix)}")
    centres = rows(extrinsics, [pose.get("center").value for pose in poses], 3)
    pointers = _Pointers()
    views = []
    for view_id, value in zip(*_entries(top.get("views")), strict=True):
        data = pointers.data_of(value)
        ids = _field(data, "id_intrinsic").whole(), _field(data, "id_pose").whole()
        views.append(View(view_id, _field(data, "local_path").text(), _field(data, "filename").text(), *ids))
    return placed_images(top.path, views, Poses(pose_ids, np.array(matrices).reshape(-1, 3, 3), centres))


def placed_images(
    path: InputPath, views: Sequence[View], poses: Poses
) -> tuple[list[PlacedImage], tuple[Finding, ...]]:
    """Return the views that have a pose and an intrinsic, and what is to be said of the poses."""
    names = [f"pose {pose_id}" for pose_id in poses.pose_id]
    quats, findings = quats_from_matrices(path, poses.matrices, names)
    translations = -rotate(quats, poses.centres)
    pose_row = {pose_id: row for row, pose_id in enumerate(poses.pose_id)}
    images = []
    for view in views:
        row = pose_row.get(view.pose_id)
        if row is None or view.camera_id == _NONE:
            continue
        shown = f"{view.folder.rstrip('/')}/{view.name}" if view.folder else view.name
        numbers = (*quats[row].tolist(), *translations[row].tolist())
        images.append(PlacedImage(view.view_id, shown, view.camera_id, numbers))
    return images, findings


def count_images(folder: InputPath) -> int:
    """Return the number of views, those without a pose included; the JSON is read, no points are made of it."""
    path = folder / FILE
    return len(JsonPlace(path, _ADVICE, read_json(path, _ADVICE)).get("views").items())


def check(folder: InputPath) -> None:
    """Raise LoadError where the file is too large to be read."""
    check_size(folder / FILE)


OPENMVG: Final = ModelFormat(name="openmvg", required=(FILE,), read=read, count_images=count_images, check=check)
