"""Plant defects into sound cameras: which values they get, what they do to the tracks, how large they end up."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.simulate.defects import (
    CORNERS,
    DefectKind,
    DefectSpec,
    PlantedDefect,
    defect_size_px,
    points_all_over,
    random_values,
    values_of_size,
    with_defect,
    words_of,
)
from sfm_audit.audit.simulate.layout import Tracks
from sfm_audit.audit.simulate.truth import TrueCameras, project_true
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.camera_models import CameraModel

_CORNER_SHARE: Final = 0.35  # of width and of height: the corner in which FEW_POINTS leaves points
_SETTLING_ROUNDS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Planting:
    """Defects with their values. ``sound`` cameras are those that ``claimed`` describes exactly."""

    specs: tuple[DefectSpec, ...]
    values: tuple[tuple[float, ...], ...]
    claimed: CameraModel
    sound: TrueCameras

    @property
    def cameras(self) -> TrueCameras:
        """The true cameras: sound ones with all defects of lens and shutter."""
        cameras = self.sound
        for spec, values in zip(self.specs, self.values, strict=True):
            cameras = with_defect(cameras, spec.image_idx, spec.kind, values)
        return cameras


def plant(
    specs: tuple[DefectSpec, ...],
    claimed: CameraModel,
    sound: TrueCameras,
    depths: tuple[float, float],
    rng: np.random.Generator,
) -> Planting:
    """Give every defect its values: those stated, or a random direction of its size on points all over the image.

    Parameters
    ----------
    depths : of those points, model units, uniform
    """
    values = []
    for spec in specs:
        if spec.values is None:
            direction, grid = random_values(spec.kind, rng), points_all_over(sound, spec.image_idx, depths, rng)
            values.append(_sized(spec, direction, claimed, sound, grid))
        else:
            values.append(spec.values)
    return Planting(specs, tuple(values), claimed, sound)


def settle(
    planting: Planting, tracks: Tracks, min_track_length: int, rng: np.random.Generator
) -> tuple[Planting, Tracks]:
    """Bring sizes and tracks into agreement.

    Images with too few points lose the others; defects are resized on the points that their image observes, since these
    are not spread like the grid; what thereby leaves an image is no observation, what falls below ``min_track_length``
    observations no point; and again, until nothing leaves.
    """
    cameras = planting.cameras
    for spec, values in zip(planting.specs, planting.values, strict=True):
        if spec.kind is DefectKind.FEW_POINTS:
            tracks = _without(tracks, _not_in_corner(tracks, cameras, spec.image_idx, values, rng))
    tracks = _without_short(tracks, min_track_length)
    if not planting.specs:
        return planting, tracks
    for _ in range(_SETTLING_ROUNDS):
        planting = dataclasses.replace(
            planting, values=tuple(_resized(planting, row, tracks) for row in range(len(planting.specs)))
        )
        outside = _outside(planting.cameras, tracks)
        if not outside.any():
            break
        tracks = _without_short(_without(tracks, outside), min_track_length)
    return planting, tracks


def planted_defects(planting: Planting, tracks: Tracks, names: tuple[str, ...]) -> tuple[PlantedDefect, ...]:
    """Return the records of all defects, by image, with their sizes measured on the points the images observe."""
    records = []
    for spec, values in zip(planting.specs, planting.values, strict=True):
        seen, size, final = _points_seen(tracks, spec.image_idx), None, values
        if spec.kind is DefectKind.FEW_POINTS:
            final = (float(len(seen)), values[1])
        else:
            size = defect_size_px(
                spec.kind,
                values,
                claimed=planting.claimed,
                cameras=planting.sound,
                image_idx=spec.image_idx,
                xyz_world=seen,
            )
        words = words_of(spec.kind, final, size)
        records.append(PlantedDefect(spec.image_idx, names[spec.image_idx], spec.kind, final, size, words))
    return tuple(sorted(records, key=lambda record: record.image_idx))


def _resized(planting: Planting, row: int, tracks: Tracks) -> tuple[float, ...]:
    """The values of a defect with its size on the points its image observes; stated values stay."""
    spec, values = planting.specs[row], planting.values[row]
    if spec.values is not None:
        return values
    return _sized(spec, values, planting.claimed, planting.sound, _points_seen(tracks, spec.image_idx))


def _sized(
    spec: DefectSpec, values: tuple[float, ...], claimed: CameraModel, sound: TrueCameras, xyz_world: FloatArray
) -> tuple[float, ...]:
    if spec.kind is DefectKind.FEW_POINTS:
        return values
    return values_of_size(
        spec.size_px,
        spec.kind,
        values,
        claimed=claimed,
        cameras=sound,
        image_idx=spec.image_idx,
        xyz_world=xyz_world,
    )


def _points_seen(tracks: Tracks, image_idx: int) -> FloatArray:
    """(n, 3) the points that an image observes."""
    return np.asarray(tracks.xyz_world[tracks.point_idx[tracks.image_idx == image_idx]])


def _outside(cameras: TrueCameras, tracks: Tracks) -> BoolArray:
    """(M,) observations that do not fall into their image."""
    xy = project_true(cameras, tracks.image_idx, tracks.xyz_world[tracks.point_idx])
    return np.asarray(~((xy >= 0) & (xy <= (cameras.width, cameras.height))).all(axis=1))


def _not_in_corner(
    tracks: Tracks, cameras: TrueCameras, image_idx: int, values: tuple[float, ...], rng: np.random.Generator
) -> BoolArray:
    """(M,) observations of an image to drop so that ``values`` = (number, corner) hold."""
    if int(values[1]) not in range(len(CORNERS)):
        raise ValueError(f"corners are 0..{len(CORNERS) - 1}, got {values[1]}")
    rows = np.flatnonzero(tracks.image_idx == image_idx)
    xy = project_true(cameras, tracks.image_idx[rows], tracks.xyz_world[tracks.point_idx[rows]])
    bottom, right = divmod(int(values[1]), 2)
    x = cameras.width - xy[:, 0] if right else xy[:, 0]
    y = cameras.height - xy[:, 1] if bottom else xy[:, 1]
    inside = rows[(x < _CORNER_SHARE * cameras.width) & (y < _CORNER_SHARE * cameras.height)]
    dropped = np.zeros(len(tracks.image_idx), dtype=np.bool_)
    dropped[rows] = True
    dropped[rng.permutation(inside)[: int(values[0])]] = False
    return dropped


def _without(tracks: Tracks, dropped: BoolArray) -> Tracks:
    """The tracks without some observations."""
    return Tracks(tracks.xyz_world, tracks.image_idx[~dropped], tracks.point_idx[~dropped])


def _without_short(tracks: Tracks, min_length: int) -> Tracks:
    """The tracks without points that too few images observe; points are numbered anew."""
    kept = np.bincount(tracks.point_idx, minlength=len(tracks.xyz_world)) >= min_length
    number = np.cumsum(kept) - 1
    seen = kept[tracks.point_idx]
    return Tracks(tracks.xyz_world[kept], tracks.image_idx[seen], number[tracks.point_idx[seen]].astype(np.int64))
