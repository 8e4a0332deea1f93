"""From what a foreign file says to the tables that all formats share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray, UInt64Array
from sfm_audit.loaders.assembly.raw import (
    RawCamera,
    RawImages,
    RawModel,
    RawPoints,
    camera_table,
    offsets_of,
    order_of_points,
)
from sfm_audit.loaders.errors import Position
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.locations import InputPath

ADVICE: Final = "export the reconstruction again"
NO_ERROR: Final = -1.0
_MANY: Final = 50
"""So many observations lie on all sides of the centre, if they are measured from it."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """All observations of a file, one row each, in the file's order.

    image_idx: (M,) rows of the list of images, -1 for an image that the file does not have or gives no pose.
    point3d_id: (M,).    xy_px: (M, 2), first pixel centre at (0.5, 0.5).
    """

    image_idx: IntArray
    point3d_id: UInt64Array
    xy_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """All 3D points of a file. point3d_id: (P,).    xyz_world: (P, 3)."""

    point3d_id: UInt64Array
    xyz_world: FloatArray


@dataclass(frozen=True, slots=True)
class PlacedImage:
    """One image with a pose: quaternion w x y z and translation, cam_from_world."""

    image_id: int
    name: str
    camera_id: int
    pose: tuple[float, ...]
    num_unlinked: int = 0


def raw_model(
    path: InputPath,
    cameras: Sequence[RawCamera],
    images: Sequence[PlacedImage],
    structure: Structure,
    links: Links,
    *,
    findings: Sequence[Finding] = (),
) -> RawModel:
    """Return the tables of a file that keeps its observations with its points.

    Parameters
    ----------
    path : the file that holds the points, for messages
    images : in the file's order, which the rows of ``links`` mean

    Raises
    ------
    MalformedFileError
        Where two points have the same id.
    """
    is_kept = links.image_idx >= 0
    lost = _lost(is_kept)
    no_tracks = np.empty(0, np.uint32)
    count = len(structure.point3d_id)
    points = RawPoints(
        point3d_id=structure.point3d_id,
        xyz_world=structure.xyz_world.reshape(-1, 3),
        stored_error_px=np.full(count, NO_ERROR),
        order=order_of_points(path, structure.point3d_id, lambda row: Position("row", row + 1)),
        track_lengths=np.zeros(count, np.int64),
        track_image_id=no_tracks,
        track_point2d_idx=no_tracks,
        has_tracks=False,
    )
    table = _image_table(images, links, is_kept)
    return RawModel(camera_table(cameras), table, points, None, None, (*findings, *lost))


def _image_table(images: Sequence[PlacedImage], links: Links, is_kept: BoolArray) -> RawImages:
    """Sort images by id, and observations by image; those of one image keep the file's order."""
    ids = np.array([image.image_id for image in images], dtype=np.int64)
    by_id = np.argsort(ids, kind="stable")
    rank = np.empty(len(images), np.int64)
    rank[by_id] = np.arange(len(images))
    kept = np.flatnonzero(is_kept)
    rows = rank[links.image_idx[kept]] if len(images) else np.empty(0, np.int64)
    order = np.argsort(rows, kind="stable")
    counts = np.bincount(rows, minlength=len(images)).astype(np.int64)
    offsets = offsets_of(counts)
    sorted_images = [images[row] for row in by_id]
    return RawImages(
        image_id=ids[by_id].astype(np.uint32),
        name=tuple(image.name for image in sorted_images),
        camera_id=np.array([image.camera_id for image in sorted_images], dtype=np.uint32),
        poses=np.array([image.pose for image in sorted_images], dtype=np.float64).reshape(-1, 7),
        num_points2d=counts + np.array([image.num_unlinked for image in sorted_images], dtype=np.int64),
        offsets=offsets,
        point2d_idx=(np.arange(len(kept)) - np.repeat(offsets[:-1], counts)).astype(np.uint32),
        xy_px=links.xy_px[kept[order]].reshape(-1, 2),
        point3d_id=links.point3d_id[kept[order]],
    )


def _lost(is_kept: BoolArray) -> tuple[Finding, ...]:
    count = int(np.count_nonzero(~is_kept))
    if not count:
        return ()
    text = f"{count} of {len(is_kept)} observations are of images without a pose, or of none; they are not read"
    return (Finding(FindingCode.OBSERVATIONS_WITHOUT_IMAGE, count, text),)


def assumed_size(xy_centred: FloatArray) -> tuple[int, int, Finding]:
    """Return the smallest image around its centre that holds all observations, for formats that store no sizes.

    Parameters
    ----------
    xy_centred : (M, 2) px from the image's centre, of all images, y up or down

    Returns
    -------
    tuple
        Width and height, even and at least 2 px, and the finding that says so.
    """
    finite = xy_centred[np.isfinite(xy_centred).all(axis=1)]
    reach = np.minimum(np.abs(finite).max(axis=0, initial=0.0), 2.0**30)
    width, height = (2 * max(1, int(np.ceil(value))) for value in reach)
    text = f"the format stores no image sizes; {width} x {height} px, in which all observations lie, was taken for all"
    if len(finite) >= _MANY and (finite >= 0).all():
        text += (
            "; no observation lies left of the centre or above it: if the program wrote px from the corner, as COLMAP's"
            " exporter does, subtract the principal points"
        )
    return width, height, Finding(FindingCode.IMAGE_SIZE_ASSUMED, 1, text)
