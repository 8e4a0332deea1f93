"""Verified matches as a database would hold them: of a model's own observations of the same points."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, UInt32Array
from sfm_audit.loaders.model import MatchedPair, SparseModel


class OwnPairs:
    """All pairs of images of a model that share at least ``min_matches`` points (`loaders.model.PairSource`).

    Right matches with the noise of the model's own observations; 2D points that are not linked are at (0, 0).
    """

    def __init__(self, model: SparseModel, min_matches: int = 15) -> None:
        self._model, self._min_matches = model, min_matches

    def pairs(self) -> Iterator[MatchedPair]:
        """Go through the pairs in the order of the images."""
        for first, second in combinations(range(len(self._model.images)), 2):
            matches = self.matches(first, second)
            if len(matches) >= self._min_matches:
                yield MatchedPair(first, second, matches)

    def matches(self, first: int, second: int) -> UInt32Array:
        """Return (m, 2) the 2D points with which two images see the same points."""
        table = self._model.observations
        rows = [slice(*table.offsets[i : i + 2]) for i in (first, second)]
        seen = [table.point_idx[each] for each in rows]
        _, *at = np.intersect1d(seen[0], seen[1], return_indices=True)
        idx = [table.point2d_idx[each][positions] for each, positions in zip(rows, at, strict=True)]
        return np.column_stack(idx).astype(np.uint32)

    def keypoints_px(self, image_idx: int) -> FloatArray:
        """Return (num_points2d, 2) the 2D points of an image, px."""
        table = self._model.observations
        rows = slice(*table.offsets[image_idx : image_idx + 2])
        out = np.zeros((int(self._model.images.num_points2d[image_idx]), 2))
        out[table.point2d_idx[rows]] = table.xy_px[rows]
        return out
