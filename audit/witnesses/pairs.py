"""What do the other images' verified matches say? (method.md section 13).

H0: a strong pair of covisible images contradicts the cameras no more often than the model's other such pairs do, at
least 1 %. Assumes that pairs contradict independently of each other; a wrong neighbour breaks one pair of an image, not
most. Blind to what all pairs agree on: a perfect fold, global scale, drift, a camera moved along its rays.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import bdtrc

from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg
from sfm_audit.audit.table.thresholds import (
    MAX_CONTRADICTING_SHARE,
    MAX_HEALTHY_PAIR_RATE,
    MIN_PAIR_THRESHOLD_PX,
    MIN_SHARED_POINTS,
    MIN_STRONG_MATCHES,
    MIN_STRONG_PAIRS,
    PAIR_THRESHOLD_SIGMAS,
)
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.epipolar import PairCounts, count_far
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.audit.witnesses.seam import seam_of
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

_LEVEL: Final = 0.01  # of the finding
_SHOWN: Final = 3


def ask_pairs(evidence: Evidence) -> WitnessReport | None:
    """Ask the verified pairs of the model's database; None where none was given."""
    if evidence.pairs is None:
        return None
    sigma_px = np.nanmedian(evidence.sigma_px) if np.isfinite(evidence.sigma_px).any() else np.nan
    threshold_px = (
        max(PAIR_THRESHOLD_SIGMAS * float(sigma_px), MIN_PAIR_THRESHOLD_PX) if sigma_px > 0 else MIN_PAIR_THRESHOLD_PX
    )
    try:
        counts = count_far(evidence.model, evidence.pairs, threshold_px)
    except LoadError as error:
        return WitnessReport(None, findings=(Finding(FindingCode.DATABASE_NOT_USED, 1, str(error)),))
    return pairs_report(evidence, counts, threshold_px)


def pairs_report(evidence: Evidence, counts: PairCounts, threshold_px: float) -> WitnessReport:
    """Return what the pairs say of each image and of the model."""
    model = evidence.model
    strong = counts.num_matches >= MIN_STRONG_MATCHES
    against = strong & (2 * counts.num_far > counts.num_matches)
    near = strong & evidence.seen.shares(counts.image_idx, MIN_SHARED_POINTS)
    num_near, num_against = (_per_image(model, counts, kept) for kept in (near, near & against))
    p = np.where(num_near >= MIN_STRONG_PAIRS, contradiction_p(num_near, num_against), np.nan)
    q = benjamini_hochberg(p)
    said = tuple(
        _statement(int(n), int(k), float(value)) if n >= MIN_STRONG_PAIRS else None
        for n, k, value in zip(num_near, num_against, q, strict=True)
    )
    columns: dict[str, ColumnValues] = {
        "num_pairs_strong": _per_image(model, counts, strong),
        "num_pairs_contradicting": _per_image(model, counts, against),
        "num_pairs_covisible": num_near,
        "num_pairs_covisible_contradicting": num_against,
        "pairs_p": p,
        "pairs_q": q,
    }
    findings = _findings(model, counts, (strong, against), threshold_px)
    return WitnessReport(Witness.PAIRS, said, columns, findings)


def contradiction_p(num_pairs: IntArray, num_against: IntArray) -> FloatArray:
    """Return (I,) p-values: binomial with the rate of the model's other pairs, at least 1 %; NaN without pairs.

    Notes
    -----
    Every pair belongs to two images, so the pairs of the model are half of the sums.
    """
    rest = 0.5 * num_pairs.sum() - num_pairs
    rest_against = 0.5 * num_against.sum() - num_against
    with np.errstate(all="ignore"):
        rate = np.maximum(np.nan_to_num(rest_against / rest), MAX_HEALTHY_PAIR_RATE)  # 0 / 0: no other pair
        p = bdtrc(num_against - 1, num_pairs, rate)
    return np.where(num_pairs > 0, p, np.nan)


def _statement(num: int, num_against: int, q: float) -> WitnessStatement:
    text = f"{num_against} of {num} strong pairs with covisible images contradict its camera, q = {q:.2g}"
    return WitnessStatement(Witness.PAIRS, num_against / num, MAX_CONTRADICTING_SHARE, text, q)


def _per_image(model: SparseModel, counts: PairCounts, kept: BoolArray) -> IntArray:
    return np.bincount(counts.image_idx[kept].ravel(), minlength=len(model.images)).astype(np.int64)


def _findings(
    model: SparseModel, counts: PairCounts, strong_against: tuple[BoolArray, BoolArray], threshold_px: float
) -> tuple[Finding, ...]:
    """Return that more strong pairs contradict than in a healthy model, and the two sides of the seam."""
    strong, against = strong_against
    num, num_against = int(strong.sum()), int(against.sum())
    if num_against < 2 or not bdtrc(num_against - 1, num, MAX_HEALTHY_PAIR_RATE) < _LEVEL:
        return ()
    sides = seam_of(counts.image_idx[strong], against[strong])
    shown = " | ".join(_named(model, side) for side in sides)
    text = (
        f"{num_against} of {num} strong verified pairs ({num_against / num:.0%}) contradict the cameras by more than "
        f"{threshold_px:.2g} px in most of their matches: false matches that the model rightly leaves out, or a fold; "
        f"sides of the seam: {shown}"
    )
    return (Finding(FindingCode.CONTRADICTED_PAIRS, num_against, text),)


def _named(model: SparseModel, side: IntArray) -> str:
    names = [model.images.name[i] for i in side[:_SHOWN].tolist()]
    return ", ".join(names) + (f" (+{len(side) - _SHOWN})" if len(side) > _SHOWN else "")
