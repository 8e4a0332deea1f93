"""What a score test says of one group, and the arithmetic from scores to p and pixels (method.md section 5)."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from audit.misfit.fields import MisfitGroup
from loaders.arrays import FloatArray

MIN_CLUSTERS_PER_RANK: Final = 4
_SINGULAR_MEAT: Final = 1e-12  # smallest squared pivot of the meat with unit diagonal


class MisfitStatus(StrEnum):
    """Why a group has a p-value, or why not.

    TESTED: p, px and rank are there.
    ABSORBED: rank 0, the fitted parameters span the group: the camera model has it, or these points cannot show it.
    NOT_ENOUGH_EVIDENCE: fewer than 4 observations (pooled: tracks) per rank, or fewer values than parameters.
    SINGULAR: the scores do not vary in every direction of the group, for instance because all residuals are zero.
    NOT_FINITE: a derivative is not finite.        NO_FIELDS: spherical cameras.
    """

    TESTED = "tested"
    ABSORBED = "absorbed"
    NOT_ENOUGH_EVIDENCE = "not_enough_evidence"
    SINGULAR = "singular"
    NOT_FINITE = "not_finite"
    NO_FIELDS = "no_fields"


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


def judged_by_f(scores: FloatArray, meat: FloatArray, num_clusters: int, num_observations: int) -> MisfitTest:
    """Steps 3 and 4: T = s^T M^-1 s against Hotelling's law, and the size of the explained field.

    Parameters
    ----------
    scores, meat : s (r,) and M (r, r) in an orthonormal basis of the group's fields

    Notes
    -----
    (T / r) (n - r) / n / (1 - T / n) ~ F(r, n - r) is T / n ~ Beta(r / 2, (n - r) / 2), whose upper tail is the
    incomplete beta function of 1 - T / n: no digits are lost however small p is.
    """
    rank, n = len(scores), num_clusters
    statistic = quadratic_form(scores, meat)
    if statistic is None:
        return not_tested(MisfitStatus.SINGULAR, rank)
    p = 0.0 if statistic >= n else float(special.betainc(0.5 * (n - rank), 0.5 * rank, 1.0 - statistic / n))
    return MisfitTest(p, systematic_px(scores, meat, num_observations), rank, MisfitStatus.TESTED)


def judged_by_chi2(scores: FloatArray, meat: FloatArray, num_observations: int) -> MisfitTest:
    """Judge pooled scores: T = s^T M^-1 s against chi^2(r); arguments as in `judged_by_f`."""
    rank = len(scores)
    statistic = quadratic_form(scores, meat)
    if statistic is None:
        return not_tested(MisfitStatus.SINGULAR, rank)
    p = float(special.gammaincc(0.5 * rank, 0.5 * statistic))
    return MisfitTest(p, systematic_px(scores, meat, num_observations), rank, MisfitStatus.TESTED)


def quadratic_form(scores: FloatArray, meat: FloatArray) -> float | None:
    """Return s^T M^-1 s; None where M is singular."""
    scale = np.sqrt(np.diagonal(meat))
    if not (scale > 0).all() or not np.isfinite(meat).all():
        return None
    try:
        factor = np.linalg.cholesky(meat / scale / scale[:, None])
    except np.linalg.LinAlgError:
        return None
    if factor.diagonal().min() ** 2 <= _SINGULAR_MEAT:
        return None
    whitened = np.linalg.solve(factor, scores / scale)
    return float(whitened @ whitened)


def systematic_px(scores: FloatArray, meat: FloatArray, num_observations: int) -> float:
    """Step 4: sqrt(max(0, |s|^2 - tr M) / n), the RMS length of the explained field, cleaned of noise, px."""
    return math.sqrt(max(0.0, float(scores @ scores - np.trace(meat))) / num_observations)
