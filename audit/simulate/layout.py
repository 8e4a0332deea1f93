"""Where the cameras stand, and which image sees which point.

The photo collection walks along a facade: cameras on a jittered grid of at most five storeys, one model unit apart,
looking along +z with random turns; points at 4 to 10 units from the image that they are drawn in, uniform over its
pixels, so that every image has points up to its corners. World frame: x along the facade, y down, z towards it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.truth import TrueCameras, cam_from_world, project_true, rays_of_pixels
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_MAX_STOREYS: Final = 5
_POSITION_JITTER: Final = 0.3  # model units, uniform in +- that, along x and y; 1.5 times along z
_TURN_LIMITS_DEG: Final = (15.0, 10.0, 6.0)  # yaw, pitch, roll, uniform in +- that
_ROUND_SHARE: Final = 0.1  # of all tracks are drawn at once, before the images' needs are looked at again
_INWARD_DEG: Final = 20.0  # of the outermost cameras, so that others see what they see
_INWARD_REACH: Final = 4.0  # model units from the end, where that has faded to nothing
_CELLS: Final = (8, 6)  # of an image, in which points are counted
_LEAST_WEIGHT: Final = 1e-3  # of the most wanting cell, for cells that have enough
_MIN_ROUND: Final = 100
_MAX_ROUNDS: Final = 200
_FIELD_OF_VIEW_MARGIN: Final = 1.01  # on the largest |ray| of the image border: beyond it a lens model may fold


@dataclass(frozen=True, slots=True)
class TrackLaw:
    """Which tracks are drawn.

    min_length, max_length, decay: P(L) ~ decay^L; a track also ends at the number of images that see its point.
    depths: nearest and farthest of a point in any image of its track, model units.
    border_px: no true projection lies closer to the image border.
    max_neighbours: so many images, nearest to the one that a point is drawn in, may see it.
    """

    min_length: int
    max_length: int
    decay: float
    depths: tuple[float, float]
    border_px: float
    max_neighbours: int


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """M observations of P points, in no particular order: xyz_world (P, 3), image_idx (M,), point_idx (M,)."""

    xyz_world: FloatArray
    image_idx: IntArray
    point_idx: IntArray


def place_cameras(num_images: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return cam_from_world rotations (I, 3, 3) and translations (I, 3) of a walk along the facade."""
    storeys = min(_MAX_STOREYS, max(1, round(math.sqrt(num_images * _MAX_STOREYS / 8))))
    centres = np.zeros((num_images, 3))
    centres[:, 0], centres[:, 1] = np.divmod(np.arange(num_images), storeys)
    centres += rng.uniform(-1.0, 1.0, (num_images, 3)) * _POSITION_JITTER * np.array([1.0, 1.0, 1.5])
    angles = rng.uniform(-1.0, 1.0, (num_images, 3)) * _TURN_LIMITS_DEG
    angles[:, 0] += _inward_deg(centres[:, 0])
    angles[:, 1] -= _inward_deg(centres[:, 1])
    rotation = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    return rotation, np.asarray(-np.einsum("iab,ib->ia", rotation, centres))


def _inward_deg(position: FloatArray) -> FloatArray:
    """(I,) degrees by which cameras near either end of the facade turn towards its middle; + at the far end."""
    near, far = position - position.min(), position.max() - position
    outer = np.maximum(1.0 - far / _INWARD_REACH, 0.0) - np.maximum(1.0 - near / _INWARD_REACH, 0.0)
    return np.asarray(_INWARD_DEG * outer)


def draw_tracks(cameras: TrueCameras, points_per_image: int, law: TrackLaw, rng: np.random.Generator) -> Tracks:
    """Draw points and choose the images that observe each, until the images have points_per_image on average.

    A point starts from an image and a pixel in a part of the image that lacks points; the rest of its track is a random
    choice among the neighbours that see it, again in favour of parts that lack points. ValueError when the cameras do
    not see enough in common.
    """
    wanted = np.full((len(cameras), _CELLS[0] * _CELLS[1]), points_per_image / (_CELLS[0] * _CELLS[1]))
    neighbours = _neighbours(cameras, law.max_neighbours)
    limit = _ray_limits(cameras)
    lengths = np.arange(law.min_length, law.max_length + 1)
    chance = law.decay**lengths / (law.decay**lengths).sum()
    round_size = max(_MIN_ROUND, math.ceil(_ROUND_SHARE * wanted.sum() / (lengths @ chance)))
    points, images, owners, num_points = [], [], [], 0
    for _ in range(_MAX_ROUNDS):
        size = min(round_size, math.ceil(wanted.sum() / (lengths @ chance)))
        chance_of_cell = np.maximum(wanted, 0.0).ravel() / np.maximum(wanted, 0.0).sum()
        seeds, cells = np.divmod(rng.choice(wanted.size, size=size, p=chance_of_cell), wanted.shape[1])
        xyz = _points_in(cameras, seeds, cells, law, rng)
        candidates = neighbours[seeds]
        cell_seen = _cells_that_see(cameras, candidates, xyz, law, limit)
        chosen = _choose(cell_seen, candidates, rng.choice(lengths, size=size, p=chance), wanted, rng)
        kept = (cell_seen[:, 0] >= 0) & (chosen.sum(axis=1) >= law.min_length)  # column 0 is the seed itself
        rows, columns = np.nonzero(chosen[kept])
        points.append(xyz[kept])
        images.append(candidates[kept][rows, columns])
        owners.append(rows + num_points)
        num_points += int(kept.sum())
        np.subtract.at(wanted, (images[-1], cell_seen[kept][rows, columns]), 1.0)
        if wanted.sum() <= 0:
            return Tracks(np.concatenate(points), np.concatenate(images), np.concatenate(owners))
    raise ValueError(f"{len(cameras)} cameras do not see enough points in common for tracks of {law.min_length} images")


def _neighbours(cameras: TrueCameras, count: int) -> IntArray:
    """(I, K) for every image itself and its nearest others, nearest first."""
    centres = -np.einsum("iba,ib->ia", cameras.rotation_cam_from_world, cameras.translation_cam_from_world)
    count = min(count, len(cameras))
    _, nearest = cKDTree(centres).query(centres, k=range(1, count + 1))
    return np.asarray(nearest, dtype=np.int64)


def _ray_limits(cameras: TrueCameras) -> FloatArray:
    """(I,) the largest |(X/Z, Y/Z)| inside each image, from points on its border."""
    share = np.linspace(0.0, 1.0, 9)
    zero, one = np.zeros_like(share), np.ones_like(share)
    border = np.concatenate(
        [np.column_stack(side) for side in ((share, zero), (share, one), (zero, share), (one, share))]
    ) * (cameras.width, cameras.height)
    num_images = len(cameras)
    rays = rays_of_pixels(cameras, np.repeat(np.arange(num_images), len(border)), np.tile(border, (num_images, 1)))
    return np.asarray(
        np.nanmax(np.hypot(rays[:, 0], rays[:, 1]).reshape(num_images, -1), axis=1) * _FIELD_OF_VIEW_MARGIN
    )


def _points_in(
    cameras: TrueCameras, seeds: IntArray, cells: IntArray, law: TrackLaw, rng: np.random.Generator
) -> FloatArray:
    """(m, 3) world points, each on the ray of a random pixel of a cell of its seed image, at a random depth."""
    size = np.array([cameras.width, cameras.height]) - 2.0 * law.border_px
    corner = np.column_stack(np.divmod(cells, _CELLS[1]))
    xy_px = law.border_px + (corner + rng.random((len(seeds), 2))) * size / _CELLS
    xyz_cam = rays_of_pixels(cameras, seeds, xy_px) * rng.uniform(*law.depths, len(seeds))[:, None]
    centred = xyz_cam - cameras.translation_cam_from_world[seeds]
    return np.asarray(np.einsum("mba,mb->ma", cameras.rotation_cam_from_world[seeds], centred))


def _cells_that_see(
    cameras: TrueCameras, candidates: IntArray, xyz_world: FloatArray, law: TrackLaw, limit: FloatArray
) -> IntArray:
    """(m, K): in which cell candidate image k sees point m; -1 outside its border, depth range or field of view."""
    image_idx = candidates.ravel()
    xyz = np.repeat(xyz_world, candidates.shape[1], axis=0)
    xyz_cam = cam_from_world(cameras.rotation_cam_from_world, cameras.translation_cam_from_world, image_idx, xyz)
    x, y, z = xyz_cam.T
    near = np.flatnonzero((z >= law.depths[0]) & (z <= law.depths[1]) & (np.hypot(x, y) <= limit[image_idx] * z))
    size = np.array([cameras.width, cameras.height]) - 2.0 * law.border_px
    cell = np.floor((project_true(cameras, image_idx[near], xyz[near]) - law.border_px) / size * _CELLS)
    inside = ((cell >= 0) & (cell < _CELLS)).all(axis=1)
    seen = np.full(len(image_idx), -1)
    seen[near[inside]] = cell[inside] @ (_CELLS[1], 1)
    return seen.reshape(candidates.shape)


def _choose(
    cell_seen: IntArray, candidates: IntArray, lengths: IntArray, wanted: FloatArray, rng: np.random.Generator
) -> BoolArray:
    """(m, K): up to ``lengths`` of the images that see a point, without replacement, the wanting ones preferred."""
    of_image = wanted.sum(axis=1, keepdims=True)
    weight = np.log(np.maximum(wanted, _LEAST_WEIGHT * wanted.max()))
    weight = weight + np.log(np.maximum(of_image, _LEAST_WEIGHT * of_image.max()))
    key = np.where(cell_seen >= 0, weight[candidates, cell_seen] + rng.gumbel(size=candidates.shape), -np.inf)
    key[:, 0] = np.inf  # the seed
    order = np.argsort(-key, axis=1)
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(order.shape[1])[None, :], axis=1)
    return np.asarray((rank < lengths[:, None]) & (cell_seen >= 0))
