"""Write a columnar model as COLMAP's cameras.bin, images.bin and points3D.bin, without one Python object per record.

Formats: COLMAP 4.2 ``src/colmap/scene/reconstruction_io_binary.cc``; no rigs.bin and frames.bin, as before COLMAP 3.12.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import IntArray
from sfm_audit.loaders.model import SparseModel

_POINT2D: Final = np.dtype([("xy", "<f8", 2), ("point3d_id", "<u8")])
_POINT3D: Final = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_TRACK_ELEMENT: Final = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
_NO_POINT: Final = np.uint64(2**64 - 1)
_GREY: Final = 128
_POINTS_PER_WRITE: Final = 1 << 15


def write_colmap_binary(model: SparseModel, folder: Path, rng: np.random.Generator) -> None:
    """Write a model in COLMAP's binary format; existing files are replaced.

    Parameters
    ----------
    model : every observation must be linked to an existing point
    folder : is made if it does not exist
    rng : places the keypoints that have no point (``num_points2d`` beyond the linked ones), uniform over the image
    """
    if (model.observations.point_idx < 0).any():
        raise ValueError("a model with dangling observations has no points3D.bin")
    folder.mkdir(parents=True, exist_ok=True)
    _write_cameras(model, folder / "cameras.bin")
    _write_images(model, folder / "images.bin", rng)
    _write_points(model, folder / "points3D.bin")


def _write_cameras(model: SparseModel, path: Path) -> None:
    """Per camera: id u32, model i32, width u64, height u64, parameters f64."""
    table = model.cameras
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(table)))
        for i in range(len(table)):
            camera = model.camera(i)
            file.write(struct.pack("<IiQQ", camera.camera_id, camera.model.model_id, camera.width, camera.height))
            file.write(camera.params.astype("<f8").tobytes())


def _write_images(model: SparseModel, path: Path, rng: np.random.Generator) -> None:
    """Per image: id u32, quaternion w x y z and translation f64, camera u32, name NUL, number u64, its 2D points."""
    images, observations = model.images, model.observations
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for i in range(len(images)):
            pose = (*images.quat_cam_from_world_wxyz[i], *images.translation_cam_from_world[i])
            file.write(struct.pack("<I7dI", images.image_id[i], *pose, images.camera_id[i]))
            file.write(images.name[i].encode() + b"\0" + struct.pack("<Q", images.num_points2d[i]))
            part = slice(*observations.offsets[i : i + 2])
            keypoints = np.empty(images.num_points2d[i], dtype=_POINT2D)
            if len(keypoints) > part.stop - part.start:
                camera = model.camera(int(images.camera_idx[i]))
                keypoints["xy"] = rng.random((len(keypoints), 2)) * (camera.width, camera.height)
            keypoints["point3d_id"] = _NO_POINT
            rows = observations.point2d_idx[part]
            keypoints["xy"][rows] = observations.xy_px[part]
            keypoints["point3d_id"][rows] = model.points.point3d_id[observations.point_idx[part]]
            file.write(keypoints.tobytes())


def _write_points(model: SparseModel, path: Path) -> None:
    """Per point: id u64, xyz f64, rgb u8, error f64, length u64, then (image id, point2D index) u32 each."""
    points, observations = model.points, model.observations
    order = np.argsort(observations.point_idx, kind="stable")
    offsets = np.searchsorted(observations.point_idx[order], np.arange(len(points) + 1))
    elements = np.empty(len(order), dtype=_TRACK_ELEMENT)
    image_of = np.repeat(model.images.image_id, np.diff(observations.offsets))
    elements["image_id"], elements["point2d_idx"] = image_of[order], observations.point2d_idx[order]
    records = np.zeros(len(points), dtype=_POINT3D)
    records["id"], records["xyz"], records["error"] = points.point3d_id, points.xyz_world, points.stored_error_px
    records["rgb"], records["length"] = _GREY, np.diff(offsets)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(points)))
        for first in range(0, len(points), _POINTS_PER_WRITE):
            last = min(first + _POINTS_PER_WRITE, len(points))
            part = elements[offsets[first] : offsets[last]]
            file.write(_interleaved(records[first:last], part, offsets[first : last + 1] - offsets[first]))


def _interleaved(records: np.ndarray, elements: np.ndarray, offsets: IntArray) -> bytes:
    """Each record followed by its own elements; record i owns elements offsets[i]:offsets[i + 1]."""
    starts = np.arange(len(records)) * _POINT3D.itemsize + offsets[:-1] * _TRACK_ELEMENT.itemsize
    out = np.empty(len(records) * _POINT3D.itemsize + len(elements) * _TRACK_ELEMENT.itemsize, dtype=np.uint8)
    out[starts[:, None] + np.arange(_POINT3D.itemsize)] = records.view(np.uint8).reshape(len(records), -1)
    owner = np.repeat(np.arange(len(records)), np.diff(offsets))
    element_starts = (owner + 1) * _POINT3D.itemsize + np.arange(len(elements)) * _TRACK_ELEMENT.itemsize
    out[element_starts[:, None] + np.arange(_TRACK_ELEMENT.itemsize)] = elements.view(np.uint8).reshape(
        len(elements), _TRACK_ELEMENT.itemsize
    )
    return out.tobytes()
