"""Models for kernels: every lens, images with no, one, few and many points, and the extremes of `cases`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from scripts.fuzzing.cases import model_case, write_case
from sfm_audit.audit.cameras import project
from sfm_audit.loaders.camera_models import CAMERA_MODELS, CameraModel

writer: Any = importlib.import_module("model_writer")

LENSES: Final = tuple(model for model in CAMERA_MODELS if model.is_colmap)
NUMBERS: Final = (300, 0, 1, 2, 3, 8, 33, 64, 65, 120, 200)
"""Points of the images of a model: none, one, on both sides of what is computed in stacks."""
_SIZE: Final = (640, 480)
_FOCAL_PX: Final = 500.0

__all__ = ["LENSES", "NUMBERS", "lens_model", "model_case", "write_case", "writer"]


def params_of(lens: CameraModel, rng: np.random.Generator) -> tuple[float, ...]:
    """Return a weak lens of a model, in the order of its file."""
    if lens.is_spherical:
        return tuple(map(float, _SIZE))
    params = rng.normal(0.0, 3e-3, lens.num_params)
    params[list(lens.focal_idxs)] = _FOCAL_PX
    params[list(lens.principal_point_idxs)] = [size / 2.0 for size in _SIZE]
    return tuple(map(float, params))


def strip_model(lens: CameraModel, rng: np.random.Generator, num_images: int) -> Any:
    """Return a model whose images see what their neighbours see: the joint system couples within a band."""
    step, seen_by_each = 40, 120
    xyz = rng.uniform((-2.0, -1.5, 5.0), (2.0, 1.5, 7.0), (step * (num_images - 1) + seen_by_each, 3))
    params = params_of(lens, rng)
    images, tracks = [], [list[tuple[int, int]]() for _ in xyz]
    for k in range(num_images):
        seen = np.arange(step * k, step * k + seen_by_each)
        centre = np.array([0.3 * (k % 5) - 0.6, 0.1 * (k % 3), 0.0])
        xy = project(lens, np.array(params), xyz[seen] - centre) + rng.normal(0.0, 0.5, (seen_by_each, 2))
        points2d = tuple((float(x), float(y), int(p) + 1) for (x, y), p in zip(xy, seen, strict=True))
        for row, point in enumerate(seen.tolist()):
            tracks[point].append((k + 1, row))
        pose = (1.0, 0.0, 0.0, 0.0, *map(float, -centre))
        images.append(writer.Image(k + 1, f"{k}.jpg", points2d, pose, k + 1))
    cameras = [writer.Camera(k + 1, lens.model_id, *_SIZE, params) for k in range(num_images)]
    points = [
        writer.Point(k + 1, tuple(track), tuple(map(float, at)), 0.5)
        for k, (track, at) in enumerate(zip(tracks, xyz, strict=True))
    ]
    return writer.Model(tuple(cameras), tuple(images), tuple(points))


def lens_model(lens: CameraModel, rng: np.random.Generator, numbers: Sequence[int], *, shared: bool) -> Any:
    """Return a model whose images see so many points each, by a shared camera or their own, with noise of 0.5 px."""
    num_points = max(numbers)
    xyz = rng.uniform((-2.0, -1.5, 5.0), (2.0, 1.5, 7.0), (num_points, 3))
    params = params_of(lens, rng)
    images = []
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(num_points)]
    for k, number in enumerate(numbers):
        centre = np.array([0.3 * k - 0.6, 0.1 * (k % 2), 0.0])
        xy = project(lens, np.array(params), xyz - centre) + rng.normal(0.0, 0.5, (num_points, 2))
        seen = np.sort(rng.choice(num_points, number, replace=False)) if number < num_points else np.arange(num_points)
        points2d = tuple((float(x), float(y), int(p) + 1) for (x, y), p in zip(xy[seen], seen, strict=True))
        for row, point in enumerate(seen.tolist()):
            tracks[point].append((k + 1, row))
        pose = (1.0, 0.0, 0.0, 0.0, *map(float, -centre))
        images.append(writer.Image(k + 1, f"{k}.jpg", points2d, pose, 1 if shared else k + 1))
    cameras = [writer.Camera(k + 1, lens.model_id, *_SIZE, params) for k in range(1 if shared else len(numbers))]
    points = [
        writer.Point(k + 1, tuple(track), tuple(map(float, at)), 0.5)
        for k, (track, at) in enumerate(zip(tracks, xyz, strict=True))
    ]
    return writer.Model(tuple(cameras), tuple(images), tuple(points))
