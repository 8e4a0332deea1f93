"""The score tests of the images of a model, as the model stands: sums of all observations first, then stacks of tests.

`audit.misfit.score.prepare` says what the numbers mean, and answers for the images that are in doubt here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.misfit.features import packed, widened, widened_columns
from sfm_audit.audit.misfit.mixed import smooth_tests
from sfm_audit.audit.misfit.outcome import MisfitTests
from sfm_audit.audit.misfit.stacked import Profiled, Sizes, profiled, tests_of_stack
from sfm_audit.audit.misfit.sums import ModelSums, WindowSums
from sfm_audit.audit.table.words import GROUPS, MisfitGroup
from sfm_audit.loaders.arrays import FloatArray, IntArray

_ALL: Final = frozenset(GROUPS)
_MAX_IMAGES: Final = 64  # whose tests are made together
_NOT_SMOOTH: Final = _ALL - {MisfitGroup.SMOOTH}


class TestedImage(NamedTuple):
    """tests: of the image as it stands.    gram: (q, q) of N.    sums: `packed`, where others share its camera."""

    tests: MisfitTests
    gram: FloatArray
    sums: FloatArray | None


class _Stack(NamedTuple):
    """Images of one camera model, of one window or of several.

    images: (B,) rows.    gram: (B, q + 40, q + 40), on_y: (B, q + 40).    found: profiled.    meat: (B, q + 42, q + 42)
    leverage: (B,)    window: the only one, None of several.
    """

    images: list[int]
    model_name: str
    num_own: int
    gram: FloatArray
    on_y: FloatArray
    found: Profiled
    meat: FloatArray
    leverage: FloatArray
    sizes: Sizes
    window: WindowSums | None


def misfit_of_images(source: ModelSums, images: Sequence[int]) -> dict[int, TestedImage]:
    """Return the score tests of images, by row of the image table; without those that `prepare` has to answer for.

    Parameters
    ----------
    images : rows; their cameras exist
    """
    out: dict[int, TestedImage] = {}
    with np.errstate(all="ignore"):  # what is out of range is in doubt
        for stack in _stacks(source.windows([image for image in images if source.can_sum(image)])):
            out |= _tested(source, stack)
    return out


def _stacks(windows: Iterable[WindowSums]) -> Iterator[_Stack]:
    """Yield what windows add up to, of several small ones together; with numpy their features are let go of before."""
    waiting: list[_Stack] = []
    for window in windows:
        own = _summed(window)
        if window.is_compiled:
            yield own._replace(window=window)
            continue
        together = sum(len(each.images) for each in waiting) + len(own.images)
        if waiting and (together > _MAX_IMAGES or waiting[0].model_name != own.model_name):
            yield _joined(waiting)
            waiting = []
        waiting.append(own)
    if waiting:
        yield _joined(waiting)


def _summed(window: WindowSums) -> _Stack:
    q = window.num_own
    gram, on_y = window.sums()
    found = profiled(widened(gram, window.offset, q), widened_columns(on_y, window.offset, q), q)
    meat, leverage, num_clusters = window.meat(found.to_basis, found.on_y)
    sizes = Sizes(window.num_observations, num_clusters)
    return _Stack(
        *(
            window.images,
            window.model_name,
            q,
            gram,
            on_y,
            found,
            widened(meat, window.offset, q),
            leverage,
            sizes,
            None,
        )
    )


def _joined(stacks: Sequence[_Stack]) -> _Stack:
    """Several stacks of one camera model as one."""
    if len(stacks) == 1:
        return stacks[0]
    first = stacks[0]
    return first._replace(
        images=[image for each in stacks for image in each.images],
        gram=np.concatenate([each.gram for each in stacks]),
        on_y=np.concatenate([each.on_y for each in stacks]),
        found=Profiled(*map(np.concatenate, zip(*(each.found for each in stacks), strict=True))),
        meat=np.concatenate([each.meat for each in stacks]),
        leverage=np.concatenate([each.leverage for each in stacks]),
        sizes=Sizes.joined([each.sizes for each in stacks]),
    )


def _tested(source: ModelSums, stack: _Stack) -> dict[int, TestedImage]:
    q, found, sizes = stack.num_own, stack.found, stack.sizes
    tests = tests_of_stack(found, stack.meat, stack.leverage, sizes)
    lacking = [b for b, own in enumerate(tests) if own is not None and _NOT_SMOOTH <= own.keys() < _ALL]
    if lacking:
        images = np.array(lacking, dtype=np.int64)
        mixed = partial(_mixed, source, stack)
        for b, test in zip(lacking, smooth_tests(found, images, q, mixed, sizes), strict=True):
            if test is not None:
                tests[b] = {**(tests[b] or {}), MisfitGroup.SMOOTH: test}
    shared = [b for b, image in enumerate(stack.images) if source.shares_camera(image)]
    sums = dict(zip(shared, packed(stack.gram[shared], stack.on_y[shared], q), strict=True)) if shared else {}
    return {
        image: TestedImage({group: test[group] for group in GROUPS}, own[:q, :q].copy(), sums.get(b))
        for b, (image, test, own) in enumerate(zip(stack.images, tests, stack.gram, strict=True))
        if test is not None and test.keys() == _ALL
    }


def _mixed(
    source: ModelSums, stack: _Stack, chosen: IntArray, mix: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`WindowSums.mixed` of chosen images of a stack."""
    basis, on_y = stack.found.to_basis, stack.found.on_y
    if stack.window is not None:
        return stack.window.mixed(basis, on_y, chosen, mix, coefficients)
    first = np.zeros(1, dtype=np.int64)
    parts = [
        WindowSums(source, [stack.images[b]]).mixed(
            basis[b, None], on_y[b, None], first, mix[k, None], coefficients[k, None]
        )
        for k, b in enumerate(chosen.tolist())
    ]
    gram, scores, meat = (np.concatenate(each) for each in zip(*parts, strict=True))
    return gram, scores, meat
