"""Verified pairs of a model whose matches are its own observations of the same points: right matches, real noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import MatchedPair, SparseModel


class OwnPairs:
    """All pairs of images of a model that share at least ``min_matches`` points."""

    def __init__(self, model: SparseModel, min_matches: int = 15) -> None:
        self._model, self._min_matches = model, min_matches

    def pairs(self) -> Iterator[MatchedPair]:
        offsets, table = self._model.observations.offsets, self._model.observations
        for first, second in combinations(range(len(self._model.images)), 2):
            rows = [slice(*offsets[i : i + 2]) for i in (first, second)]
            _, at_first, at_second = np.intersect1d(*(table.point_idx[r] for r in rows), return_indices=True)
            if len(at_first) >= self._min_matches:
                idx = [table.point2d_idx[r][at] for r, at in zip(rows, (at_first, at_second), strict=True)]
                yield MatchedPair(first, second, np.column_stack(idx).astype(np.uint32))

    def keypoints_px(self, image_idx: int) -> FloatArray:
        table = self._model.observations
        rows = slice(*table.offsets[image_idx : image_idx + 2])
        out = np.zeros((int(self._model.images.num_points2d[image_idx]), 2))
        out[table.point2d_idx[rows]] = table.xy_px[rows]
        return out


def moved_image(
    model: SparseModel, image_idx: int, turn_deg: float, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
):
    """Return the model with one camera turned about its own centre."""
    quat = model.images.quat_cam_from_world_wxyz.copy()
    translation = model.images.translation_cam_from_world.copy()
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array(axis))
    quat[image_idx] = np.roll((turn * Rotation.from_quat(np.roll(quat[image_idx], -1))).as_quat(), 1)
    translation[image_idx] = turn.apply(translation[image_idx])
    images = replace(model.images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    return replace(model, images=images)
