"""From what is known about images and models to the rows of their tables (columns: audit/table)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from sfm_audit.audit.camera_quality.measure import CameraQuality
from sfm_audit.audit.decision.decide import Decision
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.engine.camera import CameraAudit
from sfm_audit.audit.engine.image import ImageAudit
from sfm_audit.audit.inliers.stored_errors import StoredErrors
from sfm_audit.audit.misfit import GROUPS, MisfitTests
from sfm_audit.audit.noise.standardise import ModelTracks
from sfm_audit.audit.normality import NormalityTests
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.words import Member, Verdict
from sfm_audit.loaders.model import Finding, SparseModel

Row = dict[str, object]


def image_row(audit: ImageAudit, labels: ModelLabels, noise_name: str) -> Row:
    """Return the row of one image; ``ks_q`` needs all rows of the model and is left NaN."""
    inliers, image, camera = audit.inliers, audit.image, audit.image.camera
    num_inliers = len(inliers.xy_px)
    quality = audit.quality
    lost = inliers.num_behind + inliers.num_nonfinite + inliers.num_dangling
    return {
        **asdict(labels),
        "image_id": image.image_id,
        "image_name": image.name,
        "camera_id": image.camera_id,
        "camera_model": camera.model.name if camera else None,
        "width": camera.width if camera else None,
        "height": camera.height if camera else None,
        "params": camera.params if camera else None,
        "num_points2d": image.num_points2d,
        "num_linked": num_inliers + lost,
        "num_inliers": num_inliers,
        "num_behind": inliers.num_behind,
        "num_nonfinite": inliers.num_nonfinite,
        "num_dangling": inliers.num_dangling,
        "num_unverifiable": num_inliers - len(audit.noise.z),
        "num_standardised": len(audit.noise.z),
        "mean_track_length": math.nan if audit.track_length is None or not num_inliers else audit.track_length.mean(),
        "coverage": quality.coverage if quality else (0.0 if camera else math.nan),
        "occupied_cells": quality.occupied_cells if quality else (0 if camera else None),
        **_error_summary(audit),
        "noise_model": noise_name,
        **_noise_columns(audit),
        **_test_columns(audit),
        **misfit_columns(quality.misfit if quality else None),
        **cause_columns(audit.misfit),
        "advised_camera_model": audit.advised_camera_model,
        "pose_offset_px": audit.pose_offset_px,
        **_camera_columns(quality),
        "verdict": str(audit.verdict),
        **{str(member): audit.decision.of(member) for member in Member},
        "severity": None,
        "reasons": [str(reason) for reason in audit.reasons],
        "reason_details": audit.decision.all_reasons,
    }


def _error_summary(audit: ImageAudit) -> Row:
    """Reprojection errors of the inliers, px."""
    names = ("rms_px", "mean_px", "median_px", "p95_px", "max_px")
    if not len(audit.residuals_px):
        return dict.fromkeys(names, math.nan)
    sq = (audit.residuals_px**2).sum(axis=1)
    error = np.sqrt(np.sort(sq))
    values = (
        math.sqrt(sq.mean()),
        error.mean(),
        _sorted_quantile(error, 0.5),
        _sorted_quantile(error, 0.95),
        error[-1],
    )
    return dict(zip(names, map(float, values), strict=True))


def _sorted_quantile(ascending: np.ndarray[tuple[int], np.dtype[np.float64]], q: float) -> float:
    """Linear interpolation between order statistics, as numpy.quantile's default."""
    position = q * (len(ascending) - 1)
    low = int(position)
    high = min(low + 1, len(ascending) - 1)
    return float(ascending[low] + (position - low) * (ascending[high] - ascending[low]))


def _noise_columns(audit: ImageAudit) -> Row:
    noise = audit.noise
    return {
        "sigma_constant_px": audit.constant.sigma_constant_px,
        "sigma_d_px": noise.sigma_d_px,
        "sigma_l": noise.sigma_l,
        "sigma_predicted_px": noise.sigma_predicted_px,
        "scale_ratio": noise.scale_ratio,
        "noise_converged": noise.converged if len(noise.z) else None,
    }


def normality_columns(tests: NormalityTests) -> Row:
    """The tests of the chosen noise model's z, as images and calibrations have them."""
    return {
        "ks_stat": tests.ks_stat,
        "ks_p": tests.ks_p,
        "ks_fitted_p": tests.ks_fitted_p,
        "ks_norm_p": tests.ks_norm_p,
        "ks_norm_unscaled_p": tests.ks_norm_unscaled_p,
        "dap_stat": tests.dap_stat,
        "dap_p": tests.dap_p,
        "sw_stat": tests.sw_stat,
        "sw_p": tests.sw_p,
        "skewness": tests.skewness,
        "kurtosis_excess": tests.kurtosis_excess,
    }


def _test_columns(audit: ImageAudit) -> Row:
    constant = audit.constant_tests
    return {
        **normality_columns(audit.tests),
        "ks_q": math.nan,
        "ks_constant_stat": constant.ks_stat,
        "ks_constant_p": constant.ks_p,
        "ks_fitted_constant_p": constant.ks_fitted_p,
        "ks_norm_constant_p": constant.ks_norm_p,
        "dap_constant_p": constant.dap_p,
        "sw_constant_p": constant.sw_p,
        "skewness_constant": constant.skewness,
        "kurtosis_constant": constant.kurtosis_excess,
    }


def misfit_columns(tests: MisfitTests | None) -> Row:
    """Return p, px and rank of every group; the rank only where it is known."""
    row: Row = {}
    for group in GROUPS:
        test = tests[group] if tests else None
        row[f"misfit_{group}_p"] = test.p if test else math.nan
        row[f"misfit_{group}_px"] = test.px if test else math.nan
        row[f"misfit_{group}_rank"] = test.rank if test else None
    return row


def cause_columns(misfit: MisfitDecision | None) -> Row:
    """Return the named cause, its effect and q."""
    return {
        "misfit_group": str(misfit.group) if misfit and misfit.group else None,
        "misfit_px": misfit.px if misfit else math.nan,
        "misfit_q": misfit.q if misfit else math.nan,
    }


def _camera_columns(quality: CameraQuality | None) -> Row:
    known = quality.identifiability if quality else None
    plausible = quality.shape.plausibility if quality else None
    return {
        "sd_focal_px": known.sd_focal_px if known else math.nan,
        "sd_focal_rel": known.sd_focal_rel if known else math.nan,
        "sd_k1": known.sd_k1 if known else math.nan,
        "focal_over_size": plausible.focal_over_size if plausible else math.nan,
        "folds_over": plausible.folds_over if plausible else None,
        "expected_error_px": quality.expected_error_px if quality else math.nan,
    }


def camera_row(audit: CameraAudit, labels: ModelLabels) -> Row:
    """Return the row of one camera."""
    camera = audit.camera
    return {
        **asdict(labels),
        "camera_id": camera.camera_id,
        "camera_model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "params": camera.params,
        "num_images": len(audit.image_idxs),
        "num_points3d": audit.num_points,
        "num_observations": audit.num_observations,
        **misfit_columns(audit.tests),
        **cause_columns(audit.misfit),
        "advised_camera_model": audit.advised_camera_model,
        "misfit_material": bool(audit.misfit.material),
    }


def model_row(
    model: SparseModel,
    labels: ModelLabels,
    tracks: ModelTracks,
    errors: StoredErrors,
    findings: Sequence[Finding],
    decisions: Sequence[Decision],
) -> Row:
    """Return the row of one model; ``decisions`` about its images."""
    total_sq = tracks.statistics.total_sq_px2
    counts = {"": Counter(decision.verdict for decision in decisions)}
    for member in Member:
        counts[f"_{member.short}"] = Counter(
            verdict for decision in decisions if (verdict := decision.of(member)) is not None
        )
    return {
        **asdict(labels),
        "file_format": model.file_format,
        "num_cameras": len(model.cameras),
        "num_images": len(model.images),
        "num_points3d": len(model.points),
        "num_observations": len(model.observations),
        "stored_error_px": errors.stored_mean_px,
        "recomputed_point_error_px": errors.recomputed_mean_px,
        "recomputed_observation_error_px": errors.recomputed_observation_mean_px,
        "share_stale_point_errors": errors.share_stale,
        "noise_nu0": tracks.prior.nu0,
        "noise_s0_px": tracks.prior.s0_px,
        "removable_share": tracks.statistics.removable_sq_px2 / total_sq if total_sq > 0 else math.nan,
        "num_nonstationary_images": int(np.count_nonzero(tracks.nonstationary)),
        **{f"num_{verdict}{name}": count[verdict] for name, count in counts.items() for verdict in Verdict},
        "findings": list(findings),
    }
