"""Is every camera where its position prior has it? (method.md section 13).

H0: prior = similarity (centre) + error, errors of the given covariances and independent: the squared distance in their
units is chi^2 with 3 degrees of freedom, the share of the fitted similarity taken into account. Priors that scatter
more than they say are judged by their scatter (its median), those without a covariance by one estimated for all.
Blind to what the similarity takes up (global scale, place, turn), and to what is within a few sd of the sensor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, fdtri

from sfm_audit.audit.alignment import Poses, natural_order, usable_poses
from sfm_audit.audit.alignment.positions import (
    CHI2_3_MEDIAN,
    MIN_POSITIONS,
    NUM_PARAMETERS,
    PositionAlignment,
    align_positions,
    common_covariance,
)
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg
from sfm_audit.audit.table.thresholds import MAX_PRIOR_CHI2, MAX_PRIOR_SPREAD
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.audit.witnesses.sequence import shared_rms, smoothness_p
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.evidence import NotAsked, PositionPriors
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

COLUMNS: Final = ("prior_distance", "prior_chi2", "prior_p", "prior_q")
LEVEL: Final = 0.01  # of the findings about drift and spread
_DEGREES: Final = 3
_EXACT: Final = 1e-9  # share of the extent of the priors
_NEEDED: Final = 8  # positions without covariances
_MIN_DEGREES: Final = 5.0
_CUT_SHARE: Final = 0.999
_MEDIAN_DEGREES: Final = 1.58
_LEAST_P: Final = 1e-300


def ask_priors(evidence: Evidence) -> WitnessReport | None:
    """Ask the position priors; None where none were given."""
    priors = evidence.priors
    if priors is None:
        return None
    if isinstance(priors, NotAsked):
        return _silent(evidence.model, priors.reason)
    images = evidence.model.images
    quats, shifts = images.quat_cam_from_world_wxyz, images.translation_cam_from_world
    known = usable_poses(quats, shifts) & np.isfinite(priors.position).all(axis=1)
    rows = np.array([i for i in natural_order(images.name) if known[i]], dtype=np.int64)
    judged = _judged(Poses.of(quats[rows], shifts[rows]).centre, priors.position[rows], priors.covariance[rows])
    if judged is None:
        needed = f"{MIN_POSITIONS} are needed, {_NEEDED} without covariances, that lie apart"
        reason = f"{len(rows)} images have a prior; {needed}"
        return _silent(evidence.model, f"{priors.location}: {reason}")
    if not judged.reach > MAX_PRIOR_CHI2:
        reason = (
            "its positions scatter as widely about the cameras as these lie apart: its columns, unit or names differ"
        )
        return _silent(evidence.model, f"{priors.location}: {reason}, or it says nothing of so small a place")
    return _report(evidence.model, priors, rows, judged)


def _silent(model: SparseModel, reason: str) -> WitnessReport:
    columns: dict[str, ColumnValues] = {name: np.full(len(model.images), np.nan) for name in COLUMNS}
    return WitnessReport(None, columns=columns, findings=(Finding(FindingCode.PRIORS_NOT_USED, 1, reason),))


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """Priors beside the model. alignment: as of `align_positions`.    p: (n,) of each, chi2: (n,) equal to it.

    spread: of the priors in units of their covariances; NaN where these were not said.    sd_scale: of the scale.
    reach: median squared distance of the positions from their middle, in units of how they scatter about the cameras:
    what a camera would show that is wrong by as much as cameras lie apart.
    """

    alignment: PositionAlignment
    p: FloatArray
    spread: float
    sd_scale: float
    reach: float = np.inf

    @property
    def chi2(self) -> FloatArray:
        """The value of chi^2 with 3 degrees of freedom that has this p."""
        value: FloatArray = chdtri(_DEGREES, np.maximum(self.p, _LEAST_P))
        return value


def _judged(centre: FloatArray, position: FloatArray, covariance: FloatArray) -> _Judged | None:
    """Align, and judge by the covariances, or by the scatter where one of them is not known."""
    if np.isfinite(covariance).all():
        found = align_positions(centre, position, covariance)
        if found is None:
            return None
        judged = _by_covariance(found)
        return replace(judged, reach=_reach(found, position, np.linalg.inv(covariance).astype(np.float64), 1.0))
    return _by_scatter(centre, position)


def _by_covariance(found: PositionAlignment) -> _Judged:
    spread = max(found.spread, 1.0)
    p = spread_p(found.chi2 / spread**2, len(found.chi2)) if spread > 1.0 else prior_p(found.chi2)
    return _Judged(found, p, found.spread, found.sd_scale * spread)


def _reach(found: PositionAlignment, position: FloatArray, weight: FloatArray, least: float) -> float:
    """Return `_Judged.reach`; the scatter is that of all positions, in the fit or not, and at least ``least``."""
    apart = position - np.median(position, axis=0)
    far, near = (float(np.median(np.einsum("ni,nij,nj->n", x, weight, x))) for x in (apart, found.residual))
    return far / max(near / CHI2_3_MEDIAN, least, float(np.finfo(float).tiny))


def _by_scatter(centre: FloatArray, position: FloatArray) -> _Judged | None:
    """Take one covariance for all, that of the residuals: Hotelling's law, each residual left out of its own."""
    unit = np.tile(np.eye(3), (len(centre), 1, 1))
    degrees = len(centre) - NUM_PARAMETERS / _DEGREES
    if degrees < _MIN_DEGREES:
        return None
    cut = float(fdtri(_DEGREES, degrees - 2, _CUT_SHARE)) * _DEGREES * degrees / (degrees - 2)
    found = align_positions(centre, position, unit, min_spread=0.0, cut=cut)
    for _ in range(2):
        if found is None:
            return None
        common, degrees = common_covariance(found)
        extent = np.ptp(position, axis=0).max(initial=0.0)
        if degrees < _MIN_DEGREES or not np.linalg.eigvalsh(common)[0] > (_EXACT * extent) ** 2:
            return None
        found = align_positions(centre, position, np.tile(common, (len(centre), 1, 1)), cut=cut)
    if found is None:
        return None
    reach = _reach(found, position, unit, 0.0)
    return _Judged(found, hotelling_p(found, degrees), np.nan, found.sd_scale, reach)


def hotelling_p(found: PositionAlignment, degrees: float) -> FloatArray:
    """Return (n,) p-values where the covariance was estimated from the residuals in the fit.

    A residual in the fit is judged by the covariance of the others, T^2 = d^2 (v - 1) / (v - d^2), with v - 1 degrees
    of freedom; one outside by that of all, T^2 = d^2 with v; T^2 (m - 2) / (3 m) ~ F(3, m - 2) with m of them.
    """
    with np.errstate(all="ignore"):
        without = found.chi2 * (degrees - 1) / np.maximum(degrees - found.chi2, 0.0)
        distance = np.where(found.fitted, without, found.chi2)
        m = np.where(found.fitted, degrees - 1, degrees)
        p: FloatArray = fdtrc(_DEGREES, m - 2, distance * (m - 2) / (_DEGREES * m))
    return p


def _report(model: SparseModel, priors: PositionPriors, rows: IntArray, judged: _Judged) -> WitnessReport:
    distance = np.linalg.norm(judged.alignment.residual, axis=1)
    num_images = len(model.images)
    columns: dict[str, ColumnValues] = {}
    for name, value in zip(COLUMNS, (distance, judged.chi2, judged.p, benjamini_hochberg(judged.p)), strict=True):
        column = np.full(num_images, np.nan)
        column[rows] = value
        columns[name] = column
    unit = "m" if priors.is_metric else "units of the priors"
    said: list[WitnessStatement | None] = [None] * num_images
    for k, image_idx in enumerate(rows.tolist()):
        if np.isfinite(judged.p[k]):
            said[image_idx] = _statement(distance[k], unit, judged.chi2[k], float(columns["prior_q"][image_idx]))
    return WitnessReport(Witness.PRIORS, tuple(said), columns, tuple(_findings(priors, judged, unit)))


def prior_p(chi2: FloatArray) -> FloatArray:
    """Return (n,) p-values of squared distances in units of their covariance, 3 degrees of freedom."""
    p: FloatArray = chdtrc(_DEGREES, chi2)
    return p


def spread_p(chi2: FloatArray, num: int) -> FloatArray:
    """Return (n,) p-values where the distances were divided by the median of ``num`` of them.

    The median of n values of chi^2_3 has the relative variance 1.265 / n, that of chi^2 with 1.58 n degrees of freedom.
    """
    p: FloatArray = fdtrc(_DEGREES, _MEDIAN_DEGREES * num, chi2 / _DEGREES)
    return p


def _statement(distance: float, unit: str, chi2: float, q: float) -> WitnessStatement:
    text = f"its centre is {distance:.3g} {unit} from its prior, chi^2 = {chi2:.3g} of 3, q = {q:.2g}"
    return WitnessStatement(Witness.PRIORS, float(chi2), MAX_PRIOR_CHI2, text, q)


def _findings(priors: PositionPriors, judged: _Judged, unit: str) -> Iterator[Finding]:
    found = judged.alignment
    if priors.is_metric:
        scale = found.similarity.scale
        text = f"a unit of the model is {scale:.4g} m of {priors.location} (sd {100 * judged.sd_scale / scale:.2g} %)"
        yield Finding(FindingCode.PRIORS_SCALE, 1, text)
    kept = found.fitted & np.isfinite(found.whitened).all(axis=1)
    if smoothness_p(found.whitened[kept]) < LEVEL:
        drift = shared_rms(found.residual[kept])
        text = f"neighbours in the sequence share {drift:.3g} {unit} RMS of their distance from {priors.location}"
        yield Finding(FindingCode.PRIORS_DRIFT, int(kept.sum()), text)
    if judged.spread > MAX_PRIOR_SPREAD:
        text = f"{priors.location}: priors scatter {judged.spread:.2g} times as widely as their covariances say"
        yield Finding(FindingCode.PRIORS_SPREAD, len(judged.p), text)
