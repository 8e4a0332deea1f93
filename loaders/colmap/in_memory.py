"""A `pycolmap.Reconstruction` in memory: what it says, taken out as whole arrays and without files.

A Python object per observation costs about forty times what the numbers cost (scripts/bench_in_memory.py), so the 2D
points of an image are copied out of pycolmap's own array. Where its elements lie is found out with three known points
(`_layout`); where that does not come out as expected, objects are asked one by one.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, UInt32Array, UInt64Array
from sfm_audit.loaders.assembly.raw import (
    CAMERA_SENSOR,
    IDENTITY_POSE,
    UNLINKED,
    Pose,
    RawCamera,
    RawFrame,
    RawImage,
    RawModel,
    RawPoints,
    RawRig,
    Sensor,
    camera_table,
    image_columns,
)
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.errors import LoadError

if TYPE_CHECKING:
    import pycolmap

WHERE: Final = "a reconstruction in memory"
_XY_BYTES: Final = 16


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where in an element of pycolmap's array of 2D points the coordinates (at 0) and the point id lie, bytes."""

    element: np.dtype[np.void]

    def read(self, points2d: Any) -> tuple[FloatArray, UInt64Array] | None:
        """Return coordinates (n, 2) and point ids (n,), copied; None where the elements do not lie as expected."""
        size, count = self.element.itemsize, len(points2d)
        first = points2d[0].xy.ctypes.data
        if points2d[count - 1].xy.ctypes.data != first + (count - 1) * size:
            return None
        elements = np.frombuffer(ctypes.string_at(first, count * size), dtype=self.element)
        return elements["xy"], elements["id"]


def raw_model(reconstruction: pycolmap.Reconstruction) -> RawModel:
    """Return what a reconstruction says: what `write_binary` would write, so registered images alone.

    Raises
    ------
    LoadError
        A camera model or an image size that the tables do not know.
    """
    images = [_image(reconstruction.images[image_id]) for image_id in sorted(reconstruction.reg_image_ids())]
    return RawModel(
        camera_table([_camera(camera) for camera in reconstruction.cameras.values()]),
        image_columns(images),
        _points(reconstruction, sum(len(image.point2d_idx) for image in images)),
        tuple(_rig(rig) for rig in reconstruction.rigs.values()),
        tuple(_frame(frame) for frame in reconstruction.frames.values() if frame.has_pose()),
    )


def _camera(camera: Any) -> RawCamera:
    known = BY_ID.get(int(camera.model))
    where = f"{WHERE}: camera {camera.camera_id}"
    if known is None:
        wanted, advice = f"one of {len(BY_ID)} camera models", "adjust it with a camera model that COLMAP 4.2 has"
        raise LoadError(where, None, wanted, str(camera.model), advice)
    if max(camera.width, camera.height) >= 2**32:
        got = f"{camera.width} x {camera.height}"
        raise LoadError(where, None, "an image size below 2^32 px", got, "correct the camera")
    params = tuple(float(value) for value in camera.params)
    if len(params) != known.num_params:
        raise LoadError(where, None, f"{known.num_params} parameters of {known.name}", f"{len(params)}", "correct it")
    return RawCamera(camera.camera_id, known.model_id, camera.width, camera.height, params)


def _pose(rigid: Any) -> Pose:
    """Quaternion w x y z and translation; pycolmap's order is x y z w."""
    x, y, z, w = (float(value) for value in rigid.rotation.quat)
    return (w, x, y, z, *(float(value) for value in rigid.translation))


def _image(image: Any) -> RawImage:
    point2d_idx, xy_px, ids = _linked(image)
    pose = _pose(image.cam_from_world())
    return RawImage(image.image_id, pose, image.camera_id, image.name, image.num_points2D(), point2d_idx, xy_px, ids)


def _linked(image: Any) -> tuple[UInt32Array, FloatArray, UInt64Array]:
    """Positions (m,), coordinates (m, 2) and point ids (m,) of the linked 2D points."""
    layout, points2d = _layout(), image.points2D
    read = layout.read(points2d) if layout is not None and len(points2d) else None
    if read is None:
        return linked_one_by_one(image)
    xy_px, ids = read
    linked = np.flatnonzero(ids != UNLINKED).astype(np.uint32)
    return linked, xy_px[linked], ids[linked]


def linked_one_by_one(image: Any) -> tuple[UInt32Array, FloatArray, UInt64Array]:
    """Return the same as arrays are read, by way of one Python object per linked 2D point."""
    linked = np.array(image.get_observation_point2D_idxs(), dtype=np.uint32)
    points2d = image.get_observation_points2D()
    xy_px = np.array([point.xy for point in points2d], dtype=np.float64).reshape(-1, 2)
    return linked, xy_px, np.fromiter((point.point3D_id for point in points2d), np.uint64, len(points2d))


@cache
def _layout() -> _Layout | None:
    """Find out where pycolmap keeps coordinates and point ids, from three points that are known."""
    import pycolmap  # noqa: PLC0415 - whoever has a reconstruction has imported it

    known = [((1.5, -2.5), 2**40 + 7), ((3.25, 4.0), 11), ((-0.125, 1e6), 2**64 - 1)]
    points2d = pycolmap.Point2DList()
    for xy, point_id in known:
        points2d.append(pycolmap.Point2D(xy=np.array(xy), point3D_id=point_id))
    at = [point.xy.ctypes.data for point in points2d]
    size = at[1] - at[0]
    for offset in range(_XY_BYTES, size - 7, 8):
        spec = {"names": ["xy", "id"], "formats": ["(2,)<f8", "<u8"], "offsets": [0, offset], "itemsize": size}
        layout = _Layout(np.dtype(spec))  # type: ignore[call-overload] # numpy's stubs do not know this form of a spec
        read = layout.read(points2d)
        if read is not None and read[1].tolist() == [point_id for _, point_id in known]:
            return layout if read[0].tolist() == [list(xy) for xy, _ in known] else None
    return None


def _points(reconstruction: Any, num_links: int) -> RawPoints:
    """Return the 3D points; their tracks are read where COLMAP finds that they and the images disagree.

    `Reconstruction.is_valid` compares every track element with its 2D point; where they agree, and there are as many
    track elements as links, they are the same, and no object per element has to be made.
    """
    points = reconstruction.points3D
    ids = np.fromiter(points.keys(), np.uint64, len(points))
    values = list(points.values())
    lengths = np.fromiter((point.track.length() for point in values), np.int64, len(values))
    has_tracks = not _agree(reconstruction, int(lengths.sum()), num_links)
    image_ids, point2d_idxs = _tracks(values) if has_tracks else (np.empty(0, np.uint32), np.empty(0, np.uint32))
    return RawPoints(
        point3d_id=ids,
        xyz_world=np.array([point.xyz for point in values], dtype=np.float64).reshape(-1, 3),
        stored_error_px=np.fromiter((point.error for point in values), np.float64, len(values)),
        order=np.argsort(ids, kind="stable").astype(np.int64, copy=False),
        track_lengths=lengths,
        track_image_id=image_ids,
        track_point2d_idx=point2d_idxs,
        has_tracks=has_tracks,
    )


def _agree(reconstruction: Any, num_elements: int, num_links: int) -> bool:
    return num_elements == num_links and bool(reconstruction.is_valid())


def _tracks(points: list[Any]) -> tuple[UInt32Array, UInt32Array]:
    elements = list(chain.from_iterable(map(attrgetter("image_id", "point2D_idx"), p.track.elements) for p in points))
    pairs = np.array(elements, dtype=np.uint32).reshape(-1, 2)
    return pairs[:, 0].copy(), pairs[:, 1].copy()


def _sensor(sensor: Any) -> Sensor:
    return int(sensor.type), int(sensor.id)


def _rig(rig: Any) -> RawRig:
    sensors: dict[Sensor, Pose | None] = {}
    if rig.num_sensors():
        sensors[_sensor(rig.ref_sensor_id)] = IDENTITY_POSE
    for sensor, sensor_from_rig in rig.non_ref_sensors.items():
        sensors[_sensor(sensor)] = None if sensor_from_rig is None else _pose(sensor_from_rig)
    return RawRig(rig.rig_id, sensors)


def _frame(frame: Any) -> RawFrame:
    seen = [(data.id, data.sensor_id.id) for data in frame.data_ids if int(data.sensor_id.type) == CAMERA_SENSOR]
    image_ids, sensor_ids = tuple(each[0] for each in seen), tuple(each[1] for each in seen)
    return RawFrame(frame.frame_id, frame.rig_id, _pose(frame.rig_from_world), image_ids, sensor_ids)
