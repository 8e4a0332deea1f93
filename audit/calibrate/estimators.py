"""The estimators by the names that the command line and the tables use."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np

from sfm_audit.audit.calibrate.absolute_pose import absolute_pose
from sfm_audit.audit.calibrate.eaprd import eaprd
from sfm_audit.audit.calibrate.estimate import Estimate, Estimator
from sfm_audit.audit.calibrate.pnprf import pnprf
from sfm_audit.loaders.correspondences.records import Correspondences


class _Adjustable(Protocol):
    def __call__(
        self, correspondences: Correspondences, rng: np.random.Generator, *, threshold_px: float = ...
    ) -> Estimate:
        """Estimate; an inlier is nearer than the threshold to its projection."""
        ...


_ADJUSTABLE: Final[Mapping[str, _Adjustable]] = MappingProxyType(
    {
        "D1": partial(eaprd, num_coefficients=1),
        "D3": partial(eaprd, num_coefficients=3),
        "pnprf": pnprf,
        "colmap": absolute_pose,
    }
)
ESTIMATORS: Final[Mapping[str, Estimator]] = _ADJUSTABLE
"""By name, with an inlier threshold of 5 px."""


def estimator(name: str, threshold_px: float = 5.0) -> Estimator:
    """Return the estimator of that name, whose inliers are nearer than the threshold to their projection.

    Raises
    ------
    KeyError
        for another name than those of ``ESTIMATORS``.
    """
    return partial(_ADJUSTABLE[name], threshold_px=threshold_px)
