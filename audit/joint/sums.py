"""The observations of a joint system as the compiled sums see them (docs/kernels.md)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm_audit.audit.joint.observations import JointObservations
from sfm_audit.audit.kernels.joint import JointArrays, JointSums, has_joint_kernels
from sfm_audit.loaders.arrays import FloatArray


def has_joint_sums(observations: JointObservations) -> bool:
    """Whether the compiled sums can be asked.

    Not where there is no library, where points are independent (nothing is eliminated), and where an image is so large
    that its derivatives are not kept.
    """
    return has_joint_kernels() and not observations.points_independent and bool((observations.design.first >= 0).all())


def joint_sums(
    observations: JointObservations,
    left_px: FloatArray,
    weight: FloatArray,
    inverse: FloatArray,
    included: Mapping[int, FloatArray] | None = None,
) -> JointSums | None:
    """Return the compiled sums; None where the numpy path is to be taken.

    Parameters
    ----------
    left_px : (n, 2)        weight, inverse : (n,) and V^-1 (P, 3, 3)
    included : by image, fields (n_i, 2, r) that are parameters of the base

    """
    if not has_joint_sums(observations):
        return None
    return JointSums(
        JointArrays(
            observations.index,
            observations.design.kept,
            left_px,
            weight,
            inverse,
            {} if included is None else dict(included),
        )
    )


def moved_by(observations: JointObservations, step: FloatArray) -> FloatArray:
    """Return (I, C): T step of each image, ``step`` (D,); zero where an image has no columns."""
    layout = observations.layout
    padded = np.append(step[: layout.num_columns], 0.0)
    return np.asarray(np.einsum("iab,ib->ia", observations.transform, padded[layout.columns]))
