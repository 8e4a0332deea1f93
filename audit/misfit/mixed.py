"""The smooth group where plain sums have too few digits: its fields are mixed and projected before they are summed up.

A lens with next to no distortion has columns that nearly are polynomials of the predicted point. Off N 1e-4 to 1e-6 of
such a field is left, and its square is lost in a difference of sums. The directions that those sums find are good
enough to mix the fields so that all columns off N have about unit length; sums of these keep their digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.misfit.outcome import MisfitTest, refusal
from sfm_audit.audit.misfit.stacked import Profiled, Sizes, judged_by_f_together
from sfm_audit.audit.table.words import MisfitGroup
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

MixedSums = Callable[[IntArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""From chosen images (k,), mix (k, 28, 28) and coefficients (k, q, 28) to Gram matrices, scores and meat of the columns
monomials mix - N coefficients."""

_SMOOTH: Final = GROUP_COLUMNS[MisfitGroup.SMOOTH]
_FLOOR: Final = 1e-15  # of squared singular values: no column is made longer than rounding allows
_LONG: Final = 1e-7  # squared singular values above it surely count
_NEAR_LIMIT: Final = 1.1  # squared singular values within this factor of the threshold are in doubt; digits: three
_SURE_LENGTH: Final = 0.5  # squared, of the columns of the second mix, 1 up to the rounding of the first


class Mix(NamedTuple):
    """How to mix the smooth fields of B images, or cameras.

    mix: (B, 28, 28) of unit columns.    root: (B, 28) lengths off N of what is mixed, before.
    limit: (B,) squared singular values above it count.
    """

    mix: FloatArray
    root: FloatArray
    limit: FloatArray


def mix_of(left: FloatArray, before: FloatArray) -> Mix:
    """Mix by what sums say of the unit smooth fields: Gram matrices (B, 28, 28) off N, and before."""
    values, vectors = np.linalg.eigh(left)
    root = np.sqrt(np.maximum(values, _FLOOR))
    largest = np.linalg.eigvalsh(before)[:, -1]
    return Mix(vectors / root[:, None, :], root, np.asarray(basis.FIELD_THRESHOLD**2 * largest))


def transforms_of(mixed: Mix, gram: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
    """Yield images (k,) whose mixed fields have the same rank r, and transforms (k, 28, r) to an orthonormal basis.

    Parameters
    ----------
    gram : (B, 28, 28) Gram matrices of the mixed fields; images in doubt are left out
    """
    finite = np.asarray(np.isfinite(gram).all(axis=(1, 2)))
    gram = np.where(finite[:, None, None], gram, np.eye(gram.shape[1]))
    gauge, limit = _gauged(mixed.root, mixed.limit)
    values, vectors = np.linalg.eigh(_apart(gram, mixed.root) * gauge[:, :, None] * gauge[:, None, :])
    ranks, certain = _ranks_of(np.asarray(values), limit)
    certain &= finite
    for rank in np.unique(ranks[certain]).tolist():
        chosen = np.flatnonzero(certain & (ranks == rank))
        transform, good = _orthonormal(gram[chosen], gauge[chosen], values[chosen], vectors[chosen], rank)
        yield chosen[good], transform[good]


def smooth_tests(
    found: Profiled, images: IntArray, num_own: int, sums: MixedSums, sizes: Sizes
) -> list[MisfitTest | None]:
    """Return the tests of the smooth group of some images (k,); None where a rank stays in doubt.

    Parameters
    ----------
    num_own : q, the first columns of ``found``, which are profiled        sizes : of all images
    """
    left, on_basis = found.left[images][:, _SMOOTH, _SMOOTH], found.on_basis[images][:, :, _SMOOTH]
    mixed = mix_of(left, left + on_basis.swapaxes(1, 2) @ on_basis)
    scale = found.scale[images]
    coefficients = found.coefficients[images][:, :, _SMOOTH] @ mixed.mix * scale[:, :num_own, None]
    gram, scores, meat = sums(images, mixed.mix * scale[:, num_own:, None][:, _SMOOTH], coefficients)
    out: list[MisfitTest | None] = [None] * len(images)
    for chosen, transform in transforms_of(mixed, gram):
        own = sizes.of(images[chosen])
        own_meat = transform.swapaxes(1, 2) @ meat[chosen] @ transform
        judged = judged_by_f_together((scores[chosen, None] @ transform)[:, 0], own_meat, own)
        for b, num, test in zip(chosen.tolist(), own.num_clusters.tolist(), judged, strict=True):
            out[b] = refusal(transform.shape[2], num) or test
    return out


def _gauged(root: FloatArray, limit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (B, 28) in units of the longest column that may count or not, and the threshold (B,) in its square.

    Long columns all count: they get a length beyond the threshold.
    """
    is_long = root**2 > _LONG
    unit = np.where(is_long, 0.0, root).max(axis=1)
    unit = np.where(unit > 0, unit, 1.0)
    limit = limit / unit**2
    beyond = np.sqrt(10.0 * (1.0 + limit))
    return np.asarray(np.where(is_long, beyond[:, None], root / unit[:, None])), np.asarray(limit)


def _apart(gram: FloatArray, root: FloatArray) -> FloatArray:
    """The Gram matrix without products of long columns, whose rounding would be that of the short ones."""
    is_long = root**2 > _LONG
    short = ~is_long[:, :, None] & ~is_long[:, None, :]
    return np.where(short, gram, np.eye(gram.shape[1]))


def _ranks_of(values: FloatArray, limit: FloatArray) -> tuple[IntArray, BoolArray]:
    """Ranks (B,) by squared singular values (B, 28), ascending, and which are certain; limit: (B,)."""
    kept = values > limit[:, None]
    near = (values > limit[:, None] / _NEAR_LIMIT) & (values < limit[:, None] * _NEAR_LIMIT)
    return np.asarray(kept.sum(axis=1)), np.asarray(~near.any(axis=1) & kept.any(axis=1))


def _orthonormal(
    gram: FloatArray, gauge: FloatArray, values: FloatArray, vectors: FloatArray, rank: int
) -> tuple[FloatArray, BoolArray]:
    """(B, 28, r) what makes an orthonormal basis of the mixed columns, and where that came out."""
    kept = slice(values.shape[1] - rank, None)
    first = gauge[:, :, None] * vectors[:, :, kept] / np.sqrt(values[:, None, kept])
    lengths, again = np.linalg.eigh(first.swapaxes(1, 2) @ gram @ first)
    good = np.asarray(lengths[:, 0] > _SURE_LENGTH)
    lengths = np.where(good[:, None], lengths, 1.0)
    return np.asarray(first @ again / np.sqrt(lengths)[:, None, :]), good
