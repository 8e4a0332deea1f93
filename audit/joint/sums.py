"""The observations of a joint system as the compiled sums see them (docs/kernels.md)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm_audit.audit.joint.observations import JointObservations
from sfm_audit.audit.kernels.joint import JointArrays, JointSums, has_joint_kernels
from sfm_audit.loaders.arrays import FloatArray


def joint_sums(
    observations: JointObservations,
    left_px: FloatArray,
    weights: tuple[FloatArray, ...],
    inverses: tuple[FloatArray, ...],
    included: Mapping[int, FloatArray] | None = None,
) -> JointSums | None:
    """Return the compiled sums; None where the numpy path is to be taken.

    Parameters
    ----------
    left_px : (n, 2)        weights, inverses : of one system or of two, (n,) and V^-1 (P, 3, 3)
    included : by image, fields (n_i, 2, r) that are parameters of the base

    Notes
    -----
    numpy where there is no library, where points are independent (nothing is eliminated), and where an image is so
    large that its derivatives are not kept.
    """
    if not has_joint_kernels() or observations.points_independent or (observations.design.first < 0).any():
        return None
    return JointSums(
        JointArrays(
            observations.offsets,
            observations.image_idx,
            observations.point_idx,
            observations.by_point,
            observations.point_offsets,
            observations.design.kept,
            left_px,
            weights,
            inverses,
            {} if included is None else dict(included),
        )
    )


def moved_by(observations: JointObservations, step: FloatArray) -> FloatArray:
    """Return (I, C): T step of each image, ``step`` (D,); zero where an image has no columns."""
    layout = observations.layout
    padded = np.append(step[: layout.num_columns], 0.0)
    return np.asarray(np.einsum("iab,ib->ia", observations.transform, padded[layout.columns]))
