"""Misfit tests of many images side by side, adjusted for how many there are (method.md section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg, holm
from sfm_audit.audit.misfit.outcome import MisfitTests, not_tested
from sfm_audit.audit.table.words import GROUPS, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray

UNTESTED: MisfitTests = dict.fromkeys(GROUPS, not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE))
"""The tests of an image with too few observations."""


@dataclass(frozen=True, slots=True, eq=False)
class Significance:
    """Tests of many images: p, q, px each (I, 6) in the order of GROUPS, NaN where not tested.

    q: Benjamini-Hochberg over the images, per group, of Holm's adjusted p over the groups of an image.
    """

    p: FloatArray
    q: FloatArray
    px: FloatArray

    @classmethod
    def of(cls, tests: Sequence[MisfitTests]) -> Significance:
        """Adjust the p-values of a model's images."""
        shape = (len(tests), len(GROUPS))
        p = np.array([[image[group].p for group in GROUPS] for image in tests], dtype=np.float64).reshape(shape)
        px = np.array([[image[group].px for group in GROUPS] for image in tests], dtype=np.float64).reshape(shape)
        return cls(p, benjamini_hochberg(holm(p).T).T, px)
