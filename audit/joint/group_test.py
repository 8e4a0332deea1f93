"""Is a group of candidate fields in what the base leaves, and how large is it? (method.md (8))."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.table.words import MisfitStatus
from sfm_audit.loaders.arrays import FloatArray

KEPT_EIGENVALUE: Final = 1e-4  # of K with unit columns: below it, base and points absorb the direction
MIN_OBSERVATIONS_PER_RANK: Final = 4
MAX_EFFECT_OVER_RMS: Final = 1.5  # method.md section 10d (b)
_SINGULAR_MEAT: Final = 1e-12


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
    length = np.sqrt(scores.sq_length[own])
    scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    gram = scores.gram[own, own] * scale * scale[:, None]
    if not np.isfinite(gram).all():
        return np.zeros((0, len(scale)))
    values, vectors = np.linalg.eigh(gram)
    kept = values > KEPT_EIGENVALUE
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T * scale)


def test_group(scores: CandidateScores, own: slice, root: FloatArray, *, sigma_px: float, rms_px: float) -> GroupTest:
    """Test one group of an image's candidate fields.

    Parameters
    ----------
    root : L of `group_root`
    """
    if not np.isfinite(scores.gram[own, own]).all():
        return untested(MisfitStatus.NOT_FINITE)
    rank, n = len(root), scores.num_observations
    if rank == 0:
        return untested(MisfitStatus.ABSORBED, 0)
    clusters = min(scores.num_tracks, n)
    if min(n, clusters) < MIN_OBSERVATIONS_PER_RANK * rank:
        return untested(MisfitStatus.NOT_ENOUGH_EVIDENCE, rank)
    z = root @ scores.score[own]
    spread = root @ scores.meat[own, own] @ root.T
    statistic = _quadratic_form(z, spread)
    if math.isnan(statistic):
        return untested(MisfitStatus.SINGULAR, rank)
    # (T / r)(c - r) / c / (1 - T / c) ~ F(r, c - r) is T / c ~ Beta: its upper tail loses no digits
    left = max(1.0 - statistic / clusters, 0.0)
    p = float(special.betainc(0.5 * (clusters - rank), 0.5 * rank, left))
    gain = float(z @ z - np.trace(spread))
    px = sigma_px * math.sqrt(max(0.0, gain) / n)
    if px > MAX_EFFECT_OVER_RMS * rms_px:
        return untested(MisfitStatus.NOT_ESTIMABLE, rank)
    return GroupTest(p, px, gain, rank, MisfitStatus.TESTED)


def _quadratic_form(z: FloatArray, spread: FloatArray) -> float:
    """z^T M^-1 z; NaN where M is singular."""
    diagonal = spread.diagonal()
    if not np.isfinite(spread).all() or not (diagonal > 0).all():
        return math.nan
    scale = np.sqrt(diagonal)
    try:
        factor = np.linalg.cholesky(spread / scale / scale[:, None])
    except np.linalg.LinAlgError:
        return math.nan
    if factor.diagonal().min() ** 2 <= _SINGULAR_MEAT:
        return math.nan
    whitened = np.linalg.solve(factor, z / scale)
    return float(whitened @ whitened)
