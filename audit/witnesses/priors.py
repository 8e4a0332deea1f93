"""Is every camera where its position prior has it? (method.md section 13).

H0: prior = similarity (centre) + error, errors of the given covariances and independent: the squared distance in their
units is chi^2 with 3 degrees of freedom, the share of the fitted similarity taken into account. Priors that scatter
more than they say are judged by their scatter (a robust estimate), those without a covariance by that alone.
Blind to what the similarity takes up (global scale, place, turn), and to what is within a few sd of the sensor.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.special import chdtrc

from sfm_audit.audit.alignment import Poses, natural_order, usable_poses
from sfm_audit.audit.alignment.positions import MIN_POSITIONS, PositionAlignment, align_positions, rescaled
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg
from sfm_audit.audit.table.thresholds import MAX_PRIOR_CHI2, MAX_PRIOR_SPREAD
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.audit.witnesses.sequence import shared_rms, smoothness_p
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.evidence import NotAsked, PositionPriors
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

COLUMNS: Final = ("prior_distance", "prior_chi2", "prior_p", "prior_q")
LEVEL: Final = 0.01  # of the findings about drift and spread
_DEGREES: Final = 3
_EXACT: Final = 1e-9  # share of the extent of the priors


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
    said = _covariances(priors, rows)
    centre = Poses.of(quats[rows], shifts[rows]).centre
    found = align_positions(centre, priors.position[rows], said[0], min_spread=1.0 if said[1] else 0.0)
    if found is None:
        reason = f"{len(rows)} images have a prior and lie apart, {MIN_POSITIONS} are needed"
        return _silent(evidence.model, f"{priors.location}: {reason}")
    return _report(evidence.model, priors, rows, (found, said[1]))


def _silent(model: SparseModel, reason: str) -> WitnessReport:
    columns: dict[str, ColumnValues] = {name: np.full(len(model.images), np.nan) for name in COLUMNS}
    return WitnessReport(None, columns=columns, findings=(Finding(FindingCode.PRIORS_NOT_USED, 1, reason),))


def _covariances(priors: PositionPriors, rows: IntArray) -> tuple[FloatArray, bool]:
    """Return covariances (n, 3, 3), and whether they were said; where one lacks, all are taken as equal."""
    stored = priors.covariance[rows]
    if np.isfinite(stored).all() and len(rows):
        return stored, True
    return np.tile(np.eye(3), (len(rows), 1, 1)), False


def _report(
    model: SparseModel, priors: PositionPriors, rows: IntArray, aligned: tuple[PositionAlignment, bool]
) -> WitnessReport:
    found, has_covariance = aligned
    spread = max(found.spread, 1.0) if has_covariance else found.spread
    extent = np.ptp(priors.position[rows], axis=0).max(initial=0.0)
    if not has_covariance and not spread > _EXACT * extent:  # copies of each other: no noise to compare with
        return _silent(model, f"{priors.location}: its priors are the centres of the model")
    used = rescaled(found, spread)
    p = prior_p(used.chi2)
    distance = np.linalg.norm(used.residual, axis=1)
    num_images = len(model.images)
    columns: dict[str, ColumnValues] = {}
    for name, value in zip(COLUMNS, (distance, used.chi2, p, benjamini_hochberg(p)), strict=True):
        column = np.full(num_images, np.nan)
        column[rows] = value
        columns[name] = column
    unit = "m" if priors.is_metric else "units of the priors"
    said: list[WitnessStatement | None] = [None] * num_images
    for k, image_idx in enumerate(rows.tolist()):
        q = float(columns["prior_q"][image_idx])
        if np.isfinite(used.chi2[k]):
            said[image_idx] = _statement(distance[k], unit, used.chi2[k], q)
    findings = tuple(_findings(priors, (found, used), unit, has_covariance=has_covariance))
    return WitnessReport(Witness.PRIORS, tuple(said), columns, findings)


def prior_p(chi2: FloatArray) -> FloatArray:
    """Return (n,) p-values of squared distances in units of their covariance, 3 degrees of freedom."""
    p: FloatArray = chdtrc(_DEGREES, chi2)
    return p


def _statement(distance: float, unit: str, chi2: float, q: float) -> WitnessStatement:
    text = f"its centre is {distance:.3g} {unit} from its prior, chi^2 = {chi2:.3g} of 3, q = {q:.2g}"
    return WitnessStatement(Witness.PRIORS, float(chi2), MAX_PRIOR_CHI2, text, q)


def _findings(
    priors: PositionPriors, aligned: tuple[PositionAlignment, PositionAlignment], unit: str, *, has_covariance: bool
) -> Iterator[Finding]:
    found, used = aligned
    if priors.is_metric:
        scale = used.similarity.scale
        text = f"a unit of the model is {scale:.4g} m of {priors.location} (sd {100 * used.sd_scale / scale:.2g} %)"
        yield Finding(FindingCode.PRIORS_SCALE, 1, text)
    kept = _kept(used)
    if smoothness_p(used.whitened[kept]) < LEVEL:
        drift = shared_rms(used.residual[kept])
        text = f"neighbours in the sequence share {drift:.3g} {unit} RMS of their distance from {priors.location}"
        yield Finding(FindingCode.PRIORS_DRIFT, int(kept.sum()), text)
    if has_covariance and found.spread > MAX_PRIOR_SPREAD:
        text = f"{priors.location}: priors scatter {found.spread:.2g} times as widely as their covariances say"
        yield Finding(FindingCode.PRIORS_SPREAD, len(found.chi2), text)


def _kept(used: PositionAlignment) -> BoolArray:
    kept: BoolArray = used.fitted & np.isfinite(used.whitened).all(axis=1)
    return kept
