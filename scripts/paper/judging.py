"""One estimate of one set, as a row of numbers."""

from __future__ import annotations

import numpy as np

from scripts.paper.rates import SCALES, TESTS
from sfm_audit.audit.calibrate.estimate import DegenerateInputError, Estimator
from sfm_audit.audit.calibrate.lidar import lidar_predictors
from sfm_audit.audit.calibrate.validation import Validation, validate
from sfm_audit.audit.misfit import GROUPS, MisfitStatus
from sfm_audit.audit.misfit.multiplicity import holm
from sfm_audit.audit.noise.variants import fit_variance_literal
from sfm_audit.audit.normality import ks
from sfm_audit.audit.table.words import Member
from sfm_audit.loaders.correspondences.records import Correspondences

Row = dict[str, object]


def judged(
    name: str, estimator: Estimator, correspondences: Correspondences, rng: np.random.Generator
) -> tuple[Row, Validation | None]:
    """Estimate and validate with the auditor's defaults; a refusal is a row with ``refused`` and no numbers."""
    try:
        estimate = estimator(correspondences, rng)
    except DegenerateInputError as error:
        undetermined = {"verdict_misfit": "undetermined", "verdict_ks": "undetermined", "olsson_rejects": False}
        return {"model": name, "refused": error.degeneracy.value, **undetermined}, None
    found = validate(estimate, correspondences)
    return {"model": name, "refused": "no", **numbers_of(found), **other_scales(found, correspondences)}, found


def numbers_of(found: Validation) -> Row:
    """Return what the study keeps of a validation."""
    camera = found.estimate.camera
    row: Row = {"n": len(found.xy_px), "f": camera.focal_px[0], "sd_f": found.identifiability.sd_focal_px}
    row |= {f"k{i + 1}": float(k) for i, k in enumerate(camera.coefficients)}
    row |= {"sd": found.sd_px, "rms": float(np.sqrt((found.residuals_px**2).sum(axis=1).mean()))}
    for scale in SCALES:
        standardised = found.robust if scale == "robust" else found.plain
        row[f"predicted_{scale}"] = standardised.sd_px
        row |= {f"{test}_{scale}": getattr(standardised.tests, f"{test}_p") for test in TESTS}
        row[f"D_{scale}"] = standardised.tests.ks_stat
    for group in GROUPS:
        test = found.tests[group]
        row |= {f"{group}_p": test.p, f"{group}_px": test.px, f"{group}_ran": test.status is MisfitStatus.TESTED}
    row["misfit_p"] = float(np.nanmin(holm(np.array([found.tests[group].p for group in GROUPS]))))
    row["misfit_group"] = str(found.misfit.group) if found.misfit.group else "none"
    row["misfit_px"], row["tau"] = found.misfit.px, found.tau_px
    row["verdict_misfit"] = str(found.decision.of(Member.MISFIT))
    row["verdict_ks"] = str(found.decision.of(Member.KS))
    row["plausible"] = str(found.decision.of(Member.PLAUSIBLE))
    row["olsson_rejects"] = not found.olsson_accepts
    return row


def other_scales(found: Validation, correspondences: Correspondences) -> Row:
    """Return KS of the signed residuals under two more scales that the paper's words allow.

    literal: the fit from the paper's initial weights. median: the robust fit with its scale replaced by the root of the
    median square, without the factor that makes it consistent at the normal.
    """
    z = found.robust.noise.z
    row: Row = {"ks_median": ks((z / np.sqrt(np.median(z**2))).ravel()).p}
    if not correspondences.has_neighbours:
        return row
    predictor = lidar_predictors(found.estimate, correspondences)[found.estimate.inliers] ** 2
    fit = fit_variance_literal((found.residuals_px**2).ravel(), predictor.ravel())
    literal = found.residuals_px / np.sqrt(fit.detector_px2 + fit.structure * predictor)
    return row | {"ks_literal": ks(literal.ravel()).p}
