"""Buildings that look the same from several places, and what cameras around them see and match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.alignment import Poses
from sfm_audit.loaders.arrays import FloatArray, IntArray

WIDTH, HEIGHT, FOCAL = 1200, 900, 960.0
NUM_CAMERAS = 40
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
PERIOD, UNITS = 8.0, 5


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """Points that are photographed.

    xyz, normal: (n, 3).    looks: (n,) equal numbers look the same.    copy: (n,) repetition that a point is in.
    unit: typical depth, m.    turn_deg: of a copy against the one before it, about z; 0 where copies are shifted.
    """

    xyz: FloatArray
    normal: FloatArray
    looks: IntArray
    copy: IntArray
    cameras: Poses
    unit: float
    turn_deg: float


def turned_building(rng: np.random.Generator, num_unique: int) -> Building:
    """A box of 10 x 6 x 6 m, the same from opposite sides, and cameras on a circle around it."""
    walls, normals, looks, copies = [], [], [], []
    for axis, (half, away) in enumerate(((5.0, 3.0), (3.0, 5.0))):
        wall = np.c_[rng.uniform(-half, half, 330), away - rng.uniform(0, 0.4, 330), rng.uniform(0, 6, 330)]
        wall = wall if axis == 0 else wall[:, [1, 0, 2]]
        outward = np.eye(3)[1 - axis]
        for copy in range(2):
            turn = HALF_TURN if copy else np.eye(3)
            walls.append(wall @ turn)
            normals.append(np.tile(outward @ turn, (330, 1)))
            looks.append(np.arange(330) + 330 * axis)
            copies.append(np.full(330, copy))
    angle, radius = rng.uniform(0, 2 * np.pi, num_unique), rng.uniform(6.5, 9, num_unique)
    ground = np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0, 0.8, num_unique)]
    around = np.c_[np.cos(angle), np.sin(angle), np.zeros(num_unique)]
    theta = 2 * np.pi * np.arange(NUM_CAMERAS) / NUM_CAMERAS + rng.normal(0, 0.02, NUM_CAMERAS)
    centre = np.c_[17 * np.cos(theta), 17 * np.sin(theta), 2 + rng.normal(0, 0.3, NUM_CAMERAS)]
    return Building(
        np.concatenate([*walls, ground]),
        np.concatenate([*normals, around]),
        np.concatenate([*looks, 660 + np.arange(num_unique)]),
        np.concatenate([*copies, np.zeros(num_unique, np.int64)]),
        looking(centre, np.array([0, 0, 2.5]) + rng.normal(0, 0.3, (NUM_CAMERAS, 3))),
        14.0,
        180.0,
    )


def tower_building(rng: np.random.Generator, num_unique: int) -> Building:
    """A tower of 8 x 8 x 8 m, the same from four sides, and cameras on a circle around it."""
    wall = np.c_[rng.uniform(-4, 4, 400), 4 - rng.uniform(0, 0.5, 400), rng.uniform(0, 8, 400)]
    turns = [about_z(90.0 * copy) for copy in range(4)]
    angle, radius = rng.uniform(0, 2 * np.pi, num_unique), rng.uniform(6.5, 9, num_unique)
    ground = np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0, 0.8, num_unique)]
    around = np.c_[np.cos(angle), np.sin(angle), np.zeros(num_unique)]
    theta = 2 * np.pi * np.arange(NUM_CAMERAS) / NUM_CAMERAS + rng.normal(0, 0.02, NUM_CAMERAS)
    centre = np.c_[16 * np.cos(theta), 16 * np.sin(theta), 2 + rng.normal(0, 0.3, NUM_CAMERAS)]
    return Building(
        np.concatenate([*(wall @ turn.T for turn in turns), ground]),
        np.concatenate([*(np.tile(turn[:, 1], (400, 1)) for turn in turns), around]),
        np.concatenate([np.tile(np.arange(400), 4), 400 + np.arange(num_unique)]),
        np.concatenate([np.repeat(np.arange(4), 400), np.zeros(num_unique, np.int64)]),
        looking(centre, np.array([0, 0, 3.5]) + rng.normal(0, 0.3, (NUM_CAMERAS, 3))),
        12.0,
        90.0,
    )


def about_z(angle_deg: float) -> FloatArray:
    """Return the rotation about z (3, 3)."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def street_building(rng: np.random.Generator, num_unique: int) -> Building:
    """A facade of five equal units, and cameras that walk along it."""
    unit = np.c_[rng.uniform(0, PERIOD, 260), -rng.uniform(0, 0.8, 260), rng.uniform(0, 7, 260)]
    length = PERIOD * UNITS
    shifts = [unit + np.array([PERIOD * k, 0, 0]) for k in range(UNITS)]
    own = np.c_[rng.uniform(0, length, num_unique), rng.uniform(-0.5, 2, num_unique), rng.uniform(0, 5, num_unique)]
    xyz = np.concatenate([*shifts, own])
    along = np.linspace(2, length - 2, NUM_CAMERAS) + rng.normal(0, 0.1, NUM_CAMERAS)
    centre = np.c_[along, 9 + rng.normal(0, 0.4, NUM_CAMERAS), 2 + rng.normal(0, 0.3, NUM_CAMERAS)]
    aim = np.c_[along + rng.normal(0, 1.5, NUM_CAMERAS), np.zeros(NUM_CAMERAS), np.full(NUM_CAMERAS, 3.0)]
    return Building(
        xyz,
        np.tile([0.0, 1.0, 0.0], (len(xyz), 1)),
        np.concatenate([np.tile(np.arange(260), UNITS), 260 + np.arange(num_unique)]),
        np.concatenate([np.repeat(np.arange(UNITS), 260), np.zeros(num_unique, np.int64)]),
        looking(centre, aim),
        9.0,
        0.0,
    )


def looking(centre: FloatArray, at: FloatArray) -> Poses:
    """Return upright cameras that look at points."""
    forward = (at - centre) / np.linalg.norm(at - centre, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Poses(np.stack([right, np.cross(forward, right), forward], axis=1), centre)


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """What one camera sees: points (k,), keypoints (k, 2) px, unit rays to the camera (k, 3)."""

    point: IntArray
    xy_px: FloatArray
    ray: FloatArray


def photographs(rng: np.random.Generator, building: Building) -> list[Photo]:
    """Photograph points before the camera, inside, at less than 72 degrees from the wall's normal; 65 % of them."""
    out = []
    for rotation, centre in zip(building.cameras.rotation, building.cameras.centre, strict=True):
        cam = (building.xyz - centre) @ rotation.T
        xy = FOCAL * cam[:, :2] / cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        ray = centre - building.xyz
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        seen = (cam[:, 2] > 0) & (xy > 0).all(axis=1) & (xy < [WIDTH, HEIGHT]).all(axis=1)
        seen &= ((ray * building.normal).sum(axis=1) > np.cos(np.radians(72))) & (rng.random(len(ray)) < 0.65)
        point = np.flatnonzero(seen)
        out.append(Photo(point, xy[point] + rng.normal(0, 0.4, (len(point), 2)), ray[point]))
    return out


def matches(rng: np.random.Generator, building: Building, photos: list[Photo]) -> dict[tuple[int, int], IntArray]:
    """Match what looks the same, less often the more the directions differ, as descriptors do."""
    out = {}
    for i, a in enumerate(photos):
        for j, b in enumerate(photos[:i]):
            _, in_a, in_b = np.intersect1d(building.looks[a.point], building.looks[b.point], return_indices=True)
            steps = building.copy[a.point[in_a]] - building.copy[b.point[in_b]]
            ray = np.empty((len(steps), 3))
            for step in np.unique(steps).tolist():
                ray[steps == step] = b.ray[in_b[steps == step]] @ about_z(step * building.turn_deg).T
            angle = np.degrees(np.arccos(np.clip((a.ray[in_a] * ray).sum(axis=1), -1, 1)))
            kept = rng.random(len(angle)) < np.exp(-((angle / 32) ** 2))
            if np.count_nonzero(kept) >= 12:
                out[j, i] = np.c_[in_b[kept], in_a[kept]]
    return out
