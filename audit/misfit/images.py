"""The score tests of the images of a model, as the model stands: sums of all observations first, then stacks of tests.

`audit.misfit.score.prepare` says what the numbers mean, and answers for the images that are in doubt here.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.misfit.features import widened, widened_columns
from sfm_audit.audit.misfit.mixed import smooth_tests
from sfm_audit.audit.misfit.outcome import MisfitTests
from sfm_audit.audit.misfit.stacked import Sizes, profiled, tests_of_stack
from sfm_audit.audit.misfit.sums import ModelSums, WindowSums
from sfm_audit.audit.table.words import GROUPS, MisfitGroup
from sfm_audit.loaders.arrays import FloatArray

_ALL: Final = frozenset(GROUPS)
_NOT_SMOOTH: Final = _ALL - {MisfitGroup.SMOOTH}


class TestedImage(NamedTuple):
    """tests: of the image as the model stands.    gram: (q, q) of N."""

    tests: MisfitTests
    gram: FloatArray


def misfit_of_images(source: ModelSums, images: Sequence[int]) -> dict[int, TestedImage]:
    """Return the score tests of images, by row of the image table; without those that `prepare` has to answer for.

    Parameters
    ----------
    images : rows; their cameras exist
    """
    out: dict[int, TestedImage] = {}
    with np.errstate(all="ignore"):  # what is out of range is in doubt
        for window in source.windows([image for image in images if source.can_sum(image)]):
            out |= _tested(window)
    return out


def _tested(window: WindowSums) -> dict[int, TestedImage]:
    q = window.num_own
    gram, on_y = window.sums()
    found = profiled(widened(gram, window.offset, q), widened_columns(on_y, window.offset, q), q)
    meat, leverage, num_clusters = window.meat(found.to_basis, found.on_y)
    sizes = Sizes(window.num_observations, num_clusters)
    tests = tests_of_stack(found, widened(meat, window.offset, q), leverage, sizes)
    lacking = [b for b, own in enumerate(tests) if own is not None and _NOT_SMOOTH <= own.keys() < _ALL]
    if lacking:
        images = np.array(lacking, dtype=np.int64)
        mixed = partial(window.mixed, found.to_basis, found.on_y)
        for b, test in zip(lacking, smooth_tests(found, images, q, mixed, sizes), strict=True):
            if test is not None:
                tests[b] = {**(tests[b] or {}), MisfitGroup.SMOOTH: test}
    return {
        image: TestedImage({group: test[group] for group in GROUPS}, own[:q, :q].copy())
        for image, test, own in zip(window.images, tests, gram, strict=True)
        if test is not None and test.keys() == _ALL
    }
