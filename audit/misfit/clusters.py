"""Which observations of an image are one measurement? Keypoints of a pixel share their detector's error.

SIFT describes a corner once per dominant orientation: the keypoints coincide, their tracks differ, and their residuals
are copies of each other. In public models 7 to 20 % of the inliers have such a twin. The score test sums over
independent clusters, so twins count as one.
"""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray


def coincident_keypoints(xy_px: FloatArray) -> IntArray | None:
    """Return the cluster of each observation, the pixel that its keypoint (n, 2) lies in; None if all differ.

    Clusters are whole numbers >= 0, (n,). Only who counts together depends on the observed points, never the fields
    that are tested.
    """
    cell = pixels(xy_px)
    distinct, cluster = np.unique(cell, return_inverse=True)
    return None if distinct.size == cell.size else cluster.astype(np.int64)


def pixels(xy_px: FloatArray) -> IntArray:
    """Return a number >= 0 of the pixel that each keypoint (n, 2) lies in, (n,)."""
    column, row = np.floor(np.ascontiguousarray(xy_px.T)).astype(np.int64)
    height = int(row.max(initial=0) - row.min(initial=0)) + 1
    return np.asarray((column - column.min(initial=0)) * height + row - row.min(initial=0))
