"""What a score test says of one group, and the arithmetic from scores to p and pixels (method.md section 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from sfm_audit.audit.table.words import MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, IntArray

MIN_CLUSTERS_PER_RANK: Final = 4
SINGULAR_MEAT: Final = 1e-12  # smallest squared pivot of the meat with unit diagonal


class MisfitTest(NamedTuple):
    """One group in one image or camera.

    p: in [0, 1], NaN unless tested.    px: systematic_px, RMS length of the explained field, NaN unless tested.
    rank: r, None where it was not found out.
    """

    p: float
    px: float
    rank: int | None
    status: MisfitStatus


MisfitTests = dict[MisfitGroup, MisfitTest]


def not_tested(status: MisfitStatus, rank: int | None = None) -> MisfitTest:
    """Return a test without p and px."""
    return MisfitTest(math.nan, math.nan, rank, status)


def refusal(rank: int, num_clusters: int) -> MisfitTest | None:
    """Return why a group of this rank is not tested; None if it is."""
    if rank == 0:
        return not_tested(MisfitStatus.ABSORBED, 0)
    if num_clusters < MIN_CLUSTERS_PER_RANK * rank:
        return not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE, rank)
    return None


def judged_by_f(
    scores: FloatArray, meat: FloatArray, ranks: Sequence[int], num_clusters: int, num_observations: int
) -> list[MisfitTest]:
    """Steps 3 and 4 of several groups: T = s^T M^-1 s against Hotelling's law, and the size of the explained field.

    Parameters
    ----------
    scores : (R,) s of one group after the other, each in an orthonormal basis of its fields
    meat : (R, R) their M on the diagonal; what stands between two groups is not used
    ranks : of the groups, > 0, R in all

    Notes
    -----
    (T / r) (n - r) / n / (1 - T / n) ~ F(r, n - r) is T / n ~ Beta(r / 2, (n - r) / 2), whose upper tail is the
    incomplete beta function of 1 - T / n: no digits are lost however small p is.
    """
    if not ranks:
        return []
    n, rank = num_clusters, np.array(ranks, dtype=np.int64)
    starts: IntArray = np.cumsum(rank) - rank
    statistics = _quadratic_forms(scores, meat, rank)
    left = np.maximum(1.0 - statistics / n, 0.0)  # T >= n: p = 0
    p = special.betainc(0.5 * (n - rank), 0.5 * rank, left)
    cleaned = np.add.reduceat(scores**2 - meat.diagonal(), starts)
    return [
        not_tested(MisfitStatus.SINGULAR, r)
        if math.isnan(p_of)
        else MisfitTest(p_of, _systematic_px(sq, num_observations), r, MisfitStatus.TESTED)
        for r, p_of, sq in zip(ranks, p.tolist(), cleaned.tolist(), strict=True)
    ]


def judged_by_chi2(scores: FloatArray, meat: FloatArray, num_observations: int) -> MisfitTest:
    """Judge pooled scores of one group: T = s^T M^-1 s against chi^2(r), s (r,) and M (r, r)."""
    rank = len(scores)
    whitened = _whitened(scores, meat)
    if whitened is None:
        return not_tested(MisfitStatus.SINGULAR, rank)
    p = float(special.gammaincc(0.5 * rank, 0.5 * float(whitened @ whitened)))
    sq_length = float(scores @ scores - np.trace(meat))
    return MisfitTest(p, _systematic_px(sq_length, num_observations), rank, MisfitStatus.TESTED)


def _quadratic_forms(scores: FloatArray, meat: FloatArray, ranks: IntArray) -> FloatArray:
    """Return s^T M^-1 s of each group, NaN where its M is singular; arguments as in `judged_by_f`."""
    stops = np.cumsum(ranks)
    starts = stops - ranks
    group = np.repeat(np.arange(len(ranks)), ranks)
    whitened = _whitened(scores, np.where(group[:, None] == group, meat, 0.0))
    if whitened is not None:
        return np.asarray(np.add.reduceat(whitened * whitened, starts))
    blocks = [slice(start, stop) for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    if len(blocks) == 1:
        return np.array([math.nan])
    return np.concatenate(
        [_quadratic_forms(scores[own], meat[own, own], ranks[k : k + 1]) for k, own in enumerate(blocks)]
    )


def _whitened(scores: FloatArray, meat: FloatArray) -> FloatArray | None:
    """Return L^-1 s, whose squared length is s^T M^-1 s, with M = L L^T; None where M is singular."""
    scale = np.sqrt(meat.diagonal())
    if not (scale > 0).all() or not np.isfinite(meat).all():
        return None
    try:
        factor = np.linalg.cholesky(meat / scale / scale[:, None])
    except np.linalg.LinAlgError:
        return None
    if factor.diagonal().min() ** 2 <= SINGULAR_MEAT:
        return None
    return np.asarray(np.linalg.solve(factor, scores / scale))


def _systematic_px(sq_length: float, num_observations: int) -> float:
    """Step 4: sqrt(max(0, |s|^2 - tr M) / n), the RMS length of the explained field, cleaned of noise, px."""
    return math.sqrt(max(0.0, sq_length) / num_observations)
