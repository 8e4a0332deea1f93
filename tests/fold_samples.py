"""A ring of cameras around a cloud of points, whose sides may see different points."""

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraTable, ImageTable, ObservationTable, PointTable, SparseModel

NUM = 60


def sides(seed: int = 0):
    return np.random.default_rng(seed + 100).permutation(NUM) % 2


def ring_model(own_share: float, *, num_points: int = 1500, detected: float = 0.8, seed: int = 0) -> SparseModel:
    """Cameras on a circle around a cloud; half of them are of another side, and a share of the points of one side."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(NUM) / NUM
    centre = np.c_[12 * np.cos(angle), 12 * np.sin(angle), np.full(NUM, 1.0)]
    forward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    xyz = rng.normal(0, 1, (num_points, 3))
    xyz *= 3 / np.linalg.norm(xyz, axis=1, keepdims=True)  # a ball: its far side is hidden
    side = sides(seed)
    own = np.where(rng.random(num_points) < own_share, rng.integers(0, 2, num_points), -1)
    points, xys = [], []
    for j in range(NUM):
        facing = ((centre[j] - xyz) * xyz).sum(axis=1) > 0.4 * 12 * 3
        seen = np.flatnonzero(facing & ((own < 0) | (own == side[j])) & (rng.random(num_points) < detected))
        cam = (xyz[seen] - centre[j]) @ rotation[j].T
        xys.append(900 * cam[:, :2] / cam[:, 2:] + [600, 450] + rng.normal(0, 0.3, (len(seen), 2)))
        points.append(seen)
    return model_of(rotation, centre, xyz, xys, points)


def model_of(rotation, centre, xyz, xys, points) -> SparseModel:
    """A model of these poses (n, 3, 3), (n, 3), points (p, 3), and per image the observations and their points."""
    images = [len(seen) for seen in points]
    return SparseModel(
        "simulated",
        "binary",
        CameraTable(
            np.array([1], np.uint32),
            np.array([BY_NAME["SIMPLE_PINHOLE"].model_id]),
            np.array([1200]),
            np.array([900]),
            np.array([900.0, 600, 450]),
            np.array([0, 3]),
        ),
        ImageTable(
            np.arange(1, NUM + 1, dtype=np.uint32),
            tuple(f"{j:03d}.jpg" for j in range(NUM)),
            np.ones(NUM, np.uint32),
            np.zeros(NUM, np.int64),
            Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]],
            -np.einsum("nij,nj->ni", rotation, centre),
            np.array(images),
        ),
        PointTable(np.arange(len(xyz), dtype=np.uint64), xyz, np.full(len(xyz), 0.3)),
        ObservationTable(
            np.concatenate([[0], np.cumsum(images)]),
            np.concatenate([np.arange(n) for n in images]),
            np.concatenate(xys),
            np.concatenate(points),
        ),
        (),
    )
