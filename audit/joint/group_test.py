"""Is a group of candidate fields in what the base leaves, and how large is it? (method.md (8))."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from audit.joint.candidates import CandidateScores
from loaders.arrays import FloatArray

KEPT_EIGENVALUE: Final = 1e-4  # of K with unit columns: below it, base and points absorb the direction
MIN_OBSERVATIONS_PER_RANK: Final = 4
MAX_EFFECT_OVER_RMS: Final = 1.5  # method.md section 10d (b)
_SINGULAR_MEAT: Final = 1e-12


class JointStatus(StrEnum):
    """Why a group has a joint effect, or why not.

    TESTED: p, px and rank are there.        ABSORBED: base and points span the group.
    NOT_ENOUGH_EVIDENCE: fewer than 4 observations or tracks per rank.
    SINGULAR: the scores do not vary.        NOT_FINITE: a derivative is not finite.
    NO_FIELDS: spherical cameras.            NO_COLUMNS: the image takes no part in the joint system.
    EXCLUDED: the image's pose or camera is wrong otherwise; its fields are not asked for.
    NOT_ESTIMABLE: the effect exceeds 1.5 times the image's rms_px: a numerical fault, no verdict (section 10d).
    """

    TESTED = "tested"
    ABSORBED = "absorbed"
    NOT_ENOUGH_EVIDENCE = "not_enough_evidence"
    SINGULAR = "singular"
    NOT_FINITE = "not_finite"
    NO_FIELDS = "no_fields"
    NO_COLUMNS = "no_columns"
    EXCLUDED = "excluded"
    NOT_ESTIMABLE = "not_estimable"


class GroupTest(NamedTuple):
    """A group in one image: p in [0, 1], px, gain |z|^2 - tr M; NaN unless tested. rank: None where unknown."""

    p: float
    px: float
    gain: float
    rank: int | None
    status: JointStatus


def untested(status: JointStatus, rank: int | None = None) -> GroupTest:
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


def test_group(
    scores: CandidateScores, meat: FloatArray, own: slice, root: FloatArray, *, sigma_px: float, rms_px: float
) -> GroupTest:
    """Test one group of an image's candidate fields.

    Parameters
    ----------
    meat : (c, c) sum over tracks of G G^T, of all candidates        root : L of `group_root`
    """
    if not np.isfinite(scores.gram[own, own]).all():
        return untested(JointStatus.NOT_FINITE)
    rank, n = len(root), scores.num_observations
    if rank == 0:
        return untested(JointStatus.ABSORBED, 0)
    clusters = min(len(scores.track_score), n)
    if min(n, clusters) < MIN_OBSERVATIONS_PER_RANK * rank:
        return untested(JointStatus.NOT_ENOUGH_EVIDENCE, rank)
    z = root @ scores.score[own]
    spread = root @ meat[own, own] @ root.T
    statistic = _quadratic_form(z, spread)
    if math.isnan(statistic):
        return untested(JointStatus.SINGULAR, rank)
    # (T / r)(c - r) / c / (1 - T / c) ~ F(r, c - r) is T / c ~ Beta: its upper tail loses no digits
    left = max(1.0 - statistic / clusters, 0.0)
    p = float(special.betainc(0.5 * (clusters - rank), 0.5 * rank, left))
    gain = float(z @ z - np.trace(spread))
    px = sigma_px * math.sqrt(max(0.0, gain) / n)
    if px > MAX_EFFECT_OVER_RMS * rms_px:
        return untested(JointStatus.NOT_ESTIMABLE, rank)
    return GroupTest(p, px, gain, rank, JointStatus.TESTED)


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
