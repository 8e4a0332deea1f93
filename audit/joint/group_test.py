"""Is a group of candidate fields in what the base leaves, and how large is it? (method.md (8)).

Images are judged in stacks: the matrices are small, and a call for each would cost more than their arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.table.words import MisfitStatus
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

KEPT_EIGENVALUE: Final = 1e-4  # of K with unit columns: below it, base and points absorb the direction
MIN_OBSERVATIONS_PER_RANK: Final = 4
MAX_EFFECT_OVER_RMS: Final = 1.5  # method.md section 10d (b)
SINGULAR_MEAT: Final = 1e-12


class GroupTest(NamedTuple):
    """A group in one image: p in [0, 1], px, gain |z|^2 - tr M; NaN unless tested. rank: None where unknown."""

    p: float
    px: float
    gain: float
    rank: int | None
    status: MisfitStatus


def untested(status: MisfitStatus, rank: int | None = None) -> GroupTest:
    """Return a test without p and px."""
    return GroupTest(math.nan, math.nan, math.nan, rank, status)


def group_root(scores: CandidateScores, own: slice) -> FloatArray:
    """Return L (r, c) with L K L^T = 1, over eigenvalues above 1e-4 of the columns scaled by |E|."""
    roots, kept = _roots([scores], own)
    return np.asarray(roots[0, kept[0]])


def test_group(scores: CandidateScores, own: slice, root: FloatArray, *, sigma_px: float, rms_px: float) -> GroupTest:
    """Test one group of an image's candidate fields.

    Parameters
    ----------
    root : L of `group_root`
    """
    kept = np.ones((1, len(root)), dtype=bool)
    return _judged([scores], own, (root[None], kept), np.array([sigma_px]), np.array([rms_px]))[0]


def test_groups(
    scores: Sequence[CandidateScores], own: slice, sigma_px: FloatArray, rms_px: FloatArray
) -> list[GroupTest]:
    """Test one group of the candidate fields of some images, each by itself.

    Parameters
    ----------
    scores : of each image, with the same fields        sigma_px, rms_px : of each image
    """
    return _judged(scores, own, _roots(scores, own), sigma_px, rms_px) if scores else []


def _roots(scores: Sequence[CandidateScores], own: slice) -> tuple[FloatArray, BoolArray]:
    """(B, c, c) L of each image, and (B, c) which rows of it are directions that are kept; the others are zero."""
    length = np.sqrt(np.stack([each.sq_length[own] for each in scores]))
    scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    gram = np.stack([each.gram[own, own] for each in scores]) * scale[:, None, :] * scale[:, :, None]
    finite = np.isfinite(gram).all(axis=(1, 2))
    gram[~finite] = 0.0
    values, vectors = np.linalg.eigh(gram)
    kept = values > KEPT_EIGENVALUE
    by_row = (vectors / np.sqrt(np.where(kept, values, 1.0))[:, None, :]).swapaxes(1, 2)
    return np.where(kept[:, :, None], by_row * scale[:, None, :], 0.0), kept


def _judged(
    scores: Sequence[CandidateScores],
    own: slice,
    directions: tuple[FloatArray, BoolArray],
    sigma_px: FloatArray,
    rms_px: FloatArray,
) -> list[GroupTest]:
    roots, kept = directions
    finite = np.array([np.isfinite(each.gram[own, own]).all() for each in scores])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is not tested
        z = np.einsum("brc,bc->br", roots, np.stack([each.score[own] for each in scores]))
        spread = roots @ np.stack([each.meat[own, own] for each in scores]) @ roots.swapaxes(1, 2)
        statistic = _quadratic_forms(z, spread, kept)
        gain = (z * z).sum(axis=1) - np.einsum("brr->b", spread)
    numbers = GroupSums(statistic, gain, kept.sum(axis=1), finite)
    num_tracks = np.array([each.num_tracks for each in scores])
    num_observations = np.array([each.num_observations for each in scores])
    return answers(numbers, num_tracks, num_observations, sigma_px, rms_px)


class GroupSums(NamedTuple):
    """Of b groups (b,): T, NaN where its matrix is singular; |z|^2 - tr M; r; whether K is finite."""

    statistic: FloatArray
    gain: FloatArray
    rank: IntArray
    finite: BoolArray


def answers(
    sums: GroupSums, num_tracks: IntArray, num_observations: IntArray, sigma_px: FloatArray, rms_px: FloatArray
) -> list[GroupTest]:
    """Return what b groups say.

    Parameters
    ----------
    num_tracks, num_observations, sigma_px, rms_px : (b,) of the image of each
    """
    statistic, gain, ranks, finite = sums
    clusters = np.minimum(num_tracks, num_observations)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        # (T / r)(c - r) / c / (1 - T / c) ~ F(r, c - r) is T / c ~ Beta: its upper tail loses no digits
        left = np.maximum(1.0 - statistic / clusters, 0.0)
        p = special.betainc(0.5 * (clusters - ranks), 0.5 * ranks, left)
        px = sigma_px * np.sqrt(np.maximum(0.0, gain) / num_observations)
        refused = [
            (~finite, MisfitStatus.NOT_FINITE),
            (ranks == 0, MisfitStatus.ABSORBED),
            (clusters < MIN_OBSERVATIONS_PER_RANK * ranks, MisfitStatus.NOT_ENOUGH_EVIDENCE),
            (np.isnan(statistic), MisfitStatus.SINGULAR),
            (px > MAX_EFFECT_OVER_RMS * rms_px, MisfitStatus.NOT_ESTIMABLE),
        ]
    which = np.select([holds for holds, _ in refused], np.arange(len(refused)), len(refused))
    tested = MisfitStatus.TESTED
    told = zip(*(each.tolist() for each in (which, p, px, gain, ranks)), strict=True)
    return [
        GroupTest(own_p, own_px, own_gain, r, tested)
        if k == len(refused)
        else untested(refused[k][1], r if k else None)
        for k, own_p, own_px, own_gain, r in told
    ]


def _quadratic_forms(z: FloatArray, spread: FloatArray, kept: BoolArray) -> FloatArray:
    """z^T M^-1 z (B,) over the rows and columns that are kept; NaN where M is singular."""
    diagonal = np.einsum("brr->br", spread)
    regular = np.isfinite(spread).all(axis=(1, 2)) & (~kept | (diagonal > 0)).all(axis=1)
    used = kept & regular[:, None]
    scale = np.sqrt(np.where(used, diagonal, 1.0))
    scaled = np.where(used[:, :, None] & used[:, None, :], spread / scale[:, :, None] / scale[:, None, :], 0.0)
    np.einsum("brr->br", scaled)[~used] = 1.0
    factor = _cholesky(scaled)
    smallest = np.where(used, np.einsum("brr->br", factor), 1.0).min(axis=1, initial=1.0)
    sure = regular & (smallest**2 > SINGULAR_MEAT)
    out = np.full(len(z), math.nan)
    whitened = np.linalg.solve(factor[sure], (z / scale)[sure, :, None])[:, :, 0]
    out[sure] = (np.where(used[sure], whitened, 0.0) ** 2).sum(axis=1)
    return out


def _cholesky(matrices: FloatArray) -> FloatArray:
    """Lower Cholesky factors of (B, r, r); zero where there is none."""
    try:
        return np.asarray(np.linalg.cholesky(matrices))
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.zeros_like(matrices)
        return np.concatenate([_cholesky(each[None]) for each in matrices])
