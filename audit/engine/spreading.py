"""Where the stages run that look at one image at a time: in this process, in its threads, or wherever somebody says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol, TypeVar

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels.threads import RANGE_WEIGHT, num_threads, over_ranges

T = TypeVar("T")
_RANGES_PER_THREAD: Final = 8


class HasImages(Protocol):
    """An auditor of a model, whose images are spread."""

    @property
    def residuals(self) -> ModelResiduals:
        """Residuals of all inliers."""
        ...


Auditor = TypeVar("Auditor", bound=HasImages)


class Spread(Protocol[Auditor]):
    """Runs a function of an auditor and a range of images over all its images; answers in the images' order."""

    def __call__(self, function: Callable[[Auditor, range], list[T]], auditor: Auditor) -> list[T]:
        """Return what the function says about each image."""
        ...


def in_turn(function: Callable[[Auditor, range], list[T]], auditor: Auditor) -> list[T]:
    """One image after the other, in this process, or in as many ranges at the same time as threads may work."""
    counts = np.diff(auditor.residuals.offsets)
    if num_threads() <= 1 or not len(counts):
        return function(auditor, range(len(counts)))
    weight = max(RANGE_WEIGHT, float(counts.sum()) / (_RANGES_PER_THREAD * num_threads()))
    parts = over_ranges(lambda start, stop: function(auditor, range(start, stop)), len(counts), counts, weight)
    return [each for part in parts for each in part]
