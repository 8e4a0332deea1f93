r"""OpenSfM: ``reconstruction.json`` with ``tracks.csv``.

Facts, of OpenSfM's documentation ("Reconstruction file format", "Geometric models") and of ``opensfm/io.py``,
``opensfm/features.py``, ``src/geometry`` and ``src/map/src/tracks_manager.cc``:

- JSON: an array of reconstructions, each with cameras, shots and points by name. ``tracks.csv``: the line
  ``OPENSFM_TRACKS_VERSION_v1`` or ``v2`` (version 0 has none), then, separated by tabs, image, track, feature, x, y,
  and more that is not read. A point's name is its track's. Observations of images that are not in a reconstruction,
  or of tracks without a point there, are 2D points without a 3D point.
- pose: rotation vector and translation, camera from world; x right, y down, z forwards.
- image points are normalised: (px - (w, h) / 2) / max(w, h), with the first pixel's centre at (0.5, 0.5); focal
  lengths and principal points are in the same unit, the latter from the image's centre.
- lenses: perspective (k1, k2), simple_radial, radial, brown (k1, k2, k3, p1, p2 as in OpenCV), fisheye (k1, k2),
  fisheye_opencv (k1 .. k4), dual (a mean of perspective and fisheye), spherical or equirectangular. fisheye62 and
  fisheye624 are refused: their tangential terms act on the undistorted point, those of COLMAP's
  RAD_TAN_THIN_PRISM_FISHEYE on the radially distorted one.
- several reconstructions in one file have a scale each; they become one table, with a finding. 3D points are numbered
  in the file's order: one track can have a point in each of them.
- OpenSfM minimises angles between rays where it bundles; residuals here are px, observed minus projected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.foreign.json_file import JsonPlace, check_size, read_json, rows
from sfm_audit.loaders.foreign.lens import camera_of, raw_camera
from sfm_audit.loaders.foreign.rotations import quats_from_vectors
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, raw_model
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import check_text

if TYPE_CHECKING:
    from sfm_audit.loaders.foreign.opensfm_tracks import Tracks

FILE: Final = "reconstruction.json"
TRACKS: Final = "tracks.csv"
_ADVICE: Final = "check that this is OpenSfM's reconstruction, or export it again"
_SINGLE_FOCAL: Final = {"perspective": False, "fisheye": True}
_DOUBLE_FOCAL: Final = {"simple_radial": False, "radial": False, "brown": False, "fisheye_opencv": True}
_PANORAMAS: Final = {"spherical", "equirectangular"}
_COEFFICIENTS: Final = ("k1", "k2", "k3", "k4", "p1", "p2")


def read(folder: InputPath) -> RawModel:
    """Read all reconstructions of ``reconstruction.json`` with ``tracks.csv``; LoadError where that cannot be done."""
    from sfm_audit.loaders.foreign.opensfm_tracks import read_tracks  # noqa: PLC0415 - pyarrow costs others' time

    path = folder / FILE
    parts = [_Part(place) for place in _parts(path)]
    tracks = read_tracks(folder / TRACKS)
    cameras: list[RawCamera] = []
    images: list[PlacedImage] = []
    part_of_image: list[int] = []
    for number, part in enumerate(parts):
        ids = {name: len(cameras) + row for row, name in enumerate(part.cameras)}
        cameras += [_camera(ids[name], place) for name, place in part.cameras.items()]
        images += part.images(ids, len(images))
        part_of_image += [number] * (len(images) - len(part_of_image))
    first = np.cumsum([0, *(len(part.point_names) for part in parts)])
    links, unlinked = _links(
        tracks,
        _rows_by_name(parts, images),
        np.array(part_of_image, np.int64),
        _PointRows.build(parts, tracks, first),
        _sizes(cameras, images),
    )
    return raw_model(
        path,
        cameras,
        [replace(image, num_unlinked=int(count)) for image, count in zip(images, unlinked, strict=True)],
        Structure(
            np.arange(int(first[-1]), dtype=np.uint64),
            np.concatenate([np.empty((0, 3)), *(part.xyz for part in parts)]),
        ),
        links,
        findings=(*tracks.findings, *_several(parts)),
    )


def _rows_by_name(parts: list[_Part], images: list[PlacedImage]) -> dict[str, int]:
    """Return the rows of images by their names, which no two of them may share."""
    row_of: dict[str, int] = {}
    for row, image in enumerate(images):
        if image.name in row_of:
            raise parts[0].place.malformed("shots that are in one reconstruction only", f"{image.name!r:.60} again")
        row_of[image.name] = row
    return row_of


@dataclass(frozen=True, slots=True, eq=False)
class _PointRows:
    """Which 3D point does a track have in a reconstruction? key: (P,) sorted. row: (P,) of the 3D points."""

    key: IntArray
    row: IntArray
    num_tracks: int

    @classmethod
    def build(cls, parts: list[_Part], tracks: Tracks, first: IntArray) -> _PointRows:
        """Number the points of all reconstructions; ``first``: row of the first point of each."""
        position = {name: row for row, name in enumerate(tracks.track_names)}
        num_tracks = len(position)
        pairs = [
            (number * num_tracks + position[name], first[number] + row)
            for number, part in enumerate(parts)
            for row, name in enumerate(part.point_names)
            if name in position
        ]
        table = np.array(sorted(pairs), np.int64).reshape(-1, 2)
        return cls(table[:, 0].copy(), table[:, 1].copy(), num_tracks)

    def of(self, part: IntArray, track_idx: IntArray) -> IntArray:
        """Return the row of the 3D point of each track in each reconstruction, -1 where it has none."""
        if not len(self.key):
            return np.full(len(part), -1, np.int64)
        wanted = part * self.num_tracks + track_idx
        at = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        return np.where(self.key[at] == wanted, self.row[at], -1)


def _sizes(cameras: list[RawCamera], images: list[PlacedImage]) -> FloatArray:
    """Return (I, 2) width and height of every image; NaN where its camera does not exist."""
    size_of = {camera.camera_id: (float(camera.width), float(camera.height)) for camera in cameras}
    return np.array([size_of.get(image.camera_id, (np.nan, np.nan)) for image in images]).reshape(-1, 2)


class _Part:
    """One reconstruction: its cameras' places by name, its shots, and its points."""

    def __init__(self, place: JsonPlace) -> None:
        self.place = place
        cameras = place.get("cameras")
        self.cameras = {name: cameras.at(name, value) for name, value in cameras.objects().items()}
        self.shots = place.get("shots")
        points = place.find("points", {})
        self.point_names = list(points.objects())
        coordinates = [points.get(name).get("coordinates").value for name in self.point_names]
        self.xyz = rows(points, coordinates, 3)

    def images(self, camera_ids: Mapping[str, int], first: int) -> list[PlacedImage]:
        """Return the shots in the file's order, numbered from ``first``."""
        found = []
        for row, (name, value) in enumerate(self.shots.objects().items()):
            shot = self.shots.at(name, value)
            vector = np.array([shot.get("rotation").numbers(3)])
            pose = (*quats_from_vectors(vector)[0].tolist(), *shot.get("translation").numbers(3))
            camera = shot.get("camera").text()
            shown = name.encode("utf-8", errors="backslashreplace").decode("utf-8")
            found.append(PlacedImage(first + row, shown, camera_ids.get(camera, _NO_CAMERA), pose))
        return found


_NO_CAMERA: Final = 2**32 - 1


def _parts(path: InputPath) -> list[JsonPlace]:
    top = JsonPlace(path, _ADVICE, read_json(path, _ADVICE))
    return [top.at(row, value) for row, value in enumerate(top.items())]


def _several(parts: list[_Part]) -> tuple[Finding, ...]:
    if len(parts) < 2:
        return ()
    sizes = ", ".join(str(len(part.shots.objects())) for part in parts[:5])
    text = f"the file holds {len(parts)} reconstructions, of {sizes} images; none sees the points of another"
    return (Finding(FindingCode.SEVERAL_RECONSTRUCTIONS, len(parts), text),)


def _camera(camera_id: int, place: JsonPlace) -> RawCamera:
    kind = place.find("projection_type", "perspective").text()
    width, height = place.get("width").whole(), place.get("height").whole()
    scale = float(max(width, height))
    if kind in _PANORAMAS:
        if width != 2 * height:
            raise place.malformed("a panorama twice as wide as high", f"{width} x {height} px")
        return raw_camera(
            camera_id, BY_NAME["EQUIRECTANGULAR"], (width, height), {"w": float(width), "h": float(height)}
        )
    values: dict[str, float] = {name: place.find(name, 0.0).number() for name in _COEFFICIENTS}
    values |= {"cx": width / 2, "cy": height / 2}
    if kind in _DOUBLE_FOCAL:
        values |= {"fx": place.get("focal_x").number() * scale, "fy": place.get("focal_y").number() * scale}
        values["cx"] += place.find("c_x", 0.0).number() * scale
        values["cy"] += place.find("c_y", 0.0).number() * scale
    elif kind in _SINGLE_FOCAL or kind == "dual":
        values["fx"] = place.get("focal").number() * scale
    else:
        known = ", ".join([*_SINGLE_FOCAL, *_DOUBLE_FOCAL, "dual", *sorted(_PANORAMAS)])
        raise place.malformed(f"a projection_type that is read ({known})", f"{kind!r:.40}")
    if kind == "dual":
        values["transition"] = place.find("transition", 0.5).number()
        return raw_camera(camera_id, BY_NAME["DUAL"], (width, height), values)
    is_fisheye = (_SINGLE_FOCAL | _DOUBLE_FOCAL)[kind]
    try:
        return camera_of(camera_id, (width, height), values, is_fisheye=is_fisheye)
    except ValueError as error:
        raise place.malformed(f"coefficients that {kind} has", str(error)) from None


def _links(
    tracks: Tracks,
    row_of: Mapping[str, int],
    part_of_image: IntArray,
    point_rows: _PointRows,
    sizes: FloatArray,
) -> tuple[Links, IntArray]:
    """Return the observations of 3D points, and how many others every image has."""
    image_row = np.array([row_of.get(name, -1) for name in tracks.image_names], np.int64)
    image_idx = image_row[tracks.image_idx] if len(image_row) else np.empty(0, np.int64)
    is_known = image_idx >= 0
    image_idx, track_idx = image_idx[is_known], tracks.track_idx[is_known]
    points = point_rows.of(part_of_image[image_idx], track_idx)
    is_linked = points >= 0
    unlinked = np.bincount(image_idx[~is_linked], minlength=len(sizes))
    size = sizes[image_idx[is_linked]]
    xy_px = tracks.xy[is_known][is_linked] * size.max(axis=1, keepdims=True) + size / 2
    return Links(image_idx[is_linked], points[is_linked].astype(np.uint64), xy_px), unlinked


def count_images(folder: InputPath) -> int:
    """Return the number of shots of all reconstructions; the JSON is read, ``tracks.csv`` is not."""
    return sum(len(place.get("shots").objects()) for place in _parts(folder / FILE))


def check(folder: InputPath) -> None:
    """Raise LoadError where a file is too large to be read, or no text."""
    check_size(folder / FILE)
    check_text(folder / TRACKS, _ADVICE)


OPENSFM: Final = ModelFormat(name="opensfm", required=(FILE, TRACKS), read=read, count_images=count_images, check=check)
