"""The score tests of many images from their sums: stacks of small matrices, where numpy's calls are paid once.

Steps 1 to 4 of method.md section 5 as in `audit.misfit.score`, which takes one image at a time. What is subtracted here
loses digits that a projection of the columns keeps, so an image is left to it where N is nearly singular, where some
field nearly is one of the image's own columns, and where a rank is in doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.misfit.outcome import SINGULAR_MEAT, MisfitTest, MisfitTests, not_tested, refusal
from sfm_audit.audit.table.words import MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

SMALLEST_PIVOT: Final = 1e-7  # of N's Gram matrix, unit columns
SURE_NULL: Final = 1e-13  # squared singular values of unit fields below it are rounding, those above may count
LOST_DIGITS: Final = 1e-6  # largest rounding of a squared singular value that is kept, as a share of it
LOST_OF_SMOOTH: Final = 1e-8  # the same where `audit.misfit.mixed` has more
_SURE_MEAT: Final = 1e3 * SINGULAR_MEAT
_EPSILON: Final = float(np.finfo(np.float64).eps)
_MAX_LEVERAGE: Final = 0.999


class Profiled(NamedTuple):
    """B images with the first q of their columns profiled.

    sure: (B,) whose numbers hold; the others are those of a stand-in.
    scale: (B, Q) 1 / length of all columns.
    to_basis: (B, q, q) to_basis N is an orthonormal basis of N.        on_y: (B, q) y - N on_y is orthogonal to N.
    on_basis: (B, q, Q - q) coordinates of the others, of unit length before, on that basis.
    left: (B, Q - q, Q - q) their Gram matrices off N.        scores: (B, Q - q) their products with y off N.
    coefficients: (B, q, Q - q) others - N coefficients is orthogonal to N; all of unit length before.
    """

    sure: BoolArray
    scale: FloatArray
    to_basis: FloatArray
    on_y: FloatArray
    on_basis: FloatArray
    left: FloatArray
    scores: FloatArray
    coefficients: FloatArray


def profiled(gram: FloatArray, on_y: FloatArray, num_own: int) -> Profiled:
    """Profile the first ``num_own`` columns, given Gram matrices (B, Q, Q) and products with the residuals (B, Q)."""
    squares = np.diagonal(gram, axis1=1, axis2=2)
    sure = (
        basis.in_range(squares, basis.MODEST_SQUARE)
        & np.isfinite(gram).all(axis=(1, 2))
        & np.isfinite(on_y).all(axis=1)
    )
    gram = np.where(sure[:, None, None], gram, np.eye(gram.shape[1]))
    scale = 1.0 / np.sqrt(np.where(sure[:, None], squares, 1.0))
    unit = gram * scale[:, :, None] * scale[:, None, :]
    y = np.where(sure[:, None], on_y, 0.0) * scale
    own = unit[:, :num_own, :num_own]
    values = np.linalg.eigvalsh(own)
    sure &= values[:, 0] > SMALLEST_PIVOT * values[:, -1]
    inverse = np.linalg.inv(np.linalg.cholesky(np.where(sure[:, None, None], own, np.eye(num_own))))
    on_basis = inverse @ unit[:, :num_own, num_own:]
    y_on_basis = (inverse @ y[:, :num_own, None])[:, :, 0]
    coefficients = inverse.swapaxes(1, 2) @ on_basis
    return Profiled(
        sure,
        scale,
        inverse * scale[:, None, :num_own],
        (inverse.swapaxes(1, 2) @ y_on_basis[:, :, None])[:, :, 0] * scale[:, :num_own],
        on_basis,
        unit[:, num_own:, num_own:] - on_basis.swapaxes(1, 2) @ on_basis,
        y[:, num_own:] - (on_basis.swapaxes(1, 2) @ y_on_basis[:, :, None])[:, :, 0],
        coefficients,
    )


def meat_off(found: Profiled, meat: FloatArray) -> FloatArray:
    """Return (B, 42, 42) the meat of fields off N, of unit length before, from that of N and fields as they are."""
    q = found.to_basis.shape[1]
    unit = meat * found.scale[:, :, None] * found.scale[:, None, :]
    b = found.coefficients
    half = b.swapaxes(1, 2) @ (unit[:, :q, q:] - 0.5 * unit[:, :q, :q] @ b)
    return np.asarray(unit[:, q:, q:] - half - half.swapaxes(1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Sizes:
    """Of B images: observations (n) and independent ones among them."""

    num_observations: IntArray
    num_clusters: IntArray

    def of(self, chosen: IntArray) -> Sizes:
        """Return those of some of the images."""
        return Sizes(self.num_observations[chosen], self.num_clusters[chosen])

    @classmethod
    def joined(cls, parts: Sequence[Sizes]) -> Sizes:
        """Return those of some parts, one after the other."""
        each = [(part.num_observations, part.num_clusters) for part in parts]
        return cls(*map(np.concatenate, zip(*each, strict=True)))


def tests_of_stack(found: Profiled, meat: FloatArray, leverage: FloatArray, sizes: Sizes) -> list[MisfitTests | None]:
    """Return the score tests of B images, without those of groups of which the rank or the digits are in doubt.

    None where none of an image's numbers hold.

    Parameters
    ----------
    found : N profiled, fields in the units of `audit.misfit.features`
    meat : (B, q + 42, q + 42) of N and fields        leverage : (B,) largest of each image
    """
    sure = found.sure & np.isfinite(meat).all(axis=(1, 2)) & (leverage < _MAX_LEVERAGE) & (sizes.num_clusters >= 0)
    meat = np.where(sure[:, None, None], meat, 0.0)
    own_meat = meat_off(found, meat)
    num_free = 2 * sizes.num_observations - found.to_basis.shape[1]
    by_group = {group: _group_tests(found, own_meat, columns, sure, sizes) for group, columns in GROUP_COLUMNS.items()}
    out: list[MisfitTests | None] = []
    for b, (is_sure, free) in enumerate(zip(sure.tolist(), num_free.tolist(), strict=True)):
        tests: MisfitTests = {}
        for group, columns in GROUP_COLUMNS.items():
            test = by_group[group][b]
            if free < columns.stop - columns.start:
                test = not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE)
            if test is not None:
                tests[group] = test
        out.append(tests if is_sure else None)
    return out


def _group_tests(
    found: Profiled, meat: FloatArray, columns: slice, sure: BoolArray, sizes: Sizes
) -> list[MisfitTest | None]:
    """One group in all images."""
    values, vectors = np.linalg.eigh(found.left[:, columns, columns])
    lost = LOST_OF_SMOOTH if columns == GROUP_COLUMNS[MisfitGroup.SMOOTH] else LOST_DIGITS
    ranks, certain = ranks_of(values, found.coefficients[:, :, columns] @ vectors, lost)
    certain &= sure
    out: list[MisfitTest | None] = [None] * len(values)
    for rank in np.unique(ranks[certain]).tolist():
        chosen = np.flatnonzero(certain & (ranks == rank))
        refused = [refusal(rank, num) for num in sizes.num_clusters[chosen].tolist()]
        for b, test in zip(chosen.tolist(), refused, strict=True):
            out[b] = test
        tested = chosen[[test is None for test in refused]]
        if not len(tested):
            continue
        transform = vectors[tested, :, -rank:] / np.sqrt(values[tested, None, -rank:])
        scores = (found.scores[tested, None, columns] @ transform)[:, 0]
        own_meat = transform.swapaxes(1, 2) @ meat[tested, columns, columns] @ transform
        judged = judged_by_f_together(
            scores, own_meat, Sizes(sizes.num_observations[tested], sizes.num_clusters[tested])
        )
        for b, test in zip(tested.tolist(), judged, strict=True):
            out[b] = test
    return out


def ranks_of(values: FloatArray, along: FloatArray, lost: float = LOST_DIGITS) -> tuple[IntArray, BoolArray]:
    """Return ranks (B,) by squared singular values (B, c), ascending, of unit fields off N, and which are certain.

    Parameters
    ----------
    along : (B, q, c) what each singular direction was of N's unit columns: so much was subtracted for its value
    lost : share of a value that rounding may be
    """
    kept = values > SURE_NULL
    rounding = _EPSILON * (1.0 + np.einsum("bqc,bqc->bc", along, along))
    certain = (~kept | (rounding <= lost * values)).all(axis=1)
    return np.asarray(kept.sum(axis=1)), np.asarray(certain)


def judged_by_f_together(scores: FloatArray, meat: FloatArray, sizes: Sizes) -> Sequence[MisfitTest | None]:
    """Return what `judged_by_f` says of one group of B images, scores (B, r) and meat (B, r, r); None in doubt."""
    rank = scores.shape[1]
    diagonal = np.diagonal(meat, axis1=1, axis2=2)
    usual = np.asarray((diagonal > 0).all(axis=1) & np.isfinite(meat).all(axis=(1, 2)))
    root = np.sqrt(np.where(usual[:, None], diagonal, 1.0))
    unit = np.where(usual[:, None, None], meat, np.eye(rank)) / root[:, :, None] / root[:, None, :]
    factor, positive = _factors(unit)
    usual &= positive & (np.diagonal(factor, axis1=1, axis2=2).min(axis=1) ** 2 > _SURE_MEAT)
    whitened = np.linalg.solve(factor, (scores / root)[:, :, None])[:, :, 0]
    n = sizes.num_clusters
    left = np.maximum(1.0 - np.einsum("br,br->b", whitened, whitened) / n, 0.0)
    p = special.betainc(0.5 * (n - rank), 0.5 * rank, left)
    sq_length = np.einsum("br,br->b", scores, scores) - diagonal.sum(axis=1)
    px = np.sqrt(np.maximum(0.0, sq_length) / sizes.num_observations)
    return [
        MisfitTest(p_of, px_of, rank, MisfitStatus.TESTED) if is_usual and not math.isnan(p_of) else None
        for is_usual, p_of, px_of in zip(usual.tolist(), p.tolist(), px.tolist(), strict=True)
    ]


def _factors(matrices: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Cholesky factors (B, r, r), and which matrices have one; the identity in the place of the others."""
    try:
        return np.asarray(np.linalg.cholesky(matrices)), np.ones(len(matrices), dtype=np.bool_)
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.eye(matrices.shape[1])[None], np.zeros(1, dtype=np.bool_)
    parts = [_factors(matrices[b : b + 1]) for b in range(len(matrices))]
    return np.concatenate([factor for factor, _ in parts]), np.concatenate([positive for _, positive in parts])
