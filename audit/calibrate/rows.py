"""From validations to the rows of the tables ``calibration`` and ``calibration_residuals`` (audit/table/columns.py)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from sfm_audit.audit.calibrate.estimate import DegenerateInputError, Estimate
from sfm_audit.audit.calibrate.evidence import correlation_focal_depth
from sfm_audit.audit.calibrate.validation import Validation, degenerate_judgement
from sfm_audit.audit.decision.columns import cause_columns
from sfm_audit.audit.engine.rows import misfit_columns, normality_columns
from sfm_audit.audit.normality import NormalityTests
from sfm_audit.audit.table import build_table, schema
from sfm_audit.audit.table.given import Coded, Values
from sfm_audit.audit.table.words import Member, Verdict
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

Row = dict[str, Any]

MEMBERS: Final = (Member.KS, Member.MISFIT, Member.POSE, Member.PLAUSIBLE, Member.NOISE)
"""The questions that are asked of an estimate."""


def calibration_row(found: Validation, correspondences: Correspondences, location: str, alpha: float) -> Row:
    """Return the row of one validated estimate."""
    estimate, noise = found.estimate, found.robust.noise
    return {
        "correspondences": location,
        **_camera_columns(estimate),
        "num_correspondences": correspondences.num,
        "num_inliers": len(found.xy_px),
        **_error_columns(found),
        "noise_model": found.noise_name,
        "sd_px": found.sd_px,
        "sd_predicted_px": found.robust.sd_px,
        "sigma_constant_px": found.sigma_constant_px,
        "sigma_d_px": noise.sigma_d_px,
        "sigma_l": noise.sigma_l,
        "noise_converged": noise.converged,
        **_test_columns(found, alpha),
        **misfit_columns(found.tests),
        **cause_columns(found.misfit),
        "tau_px": found.tau_px,
        **_evidence_columns(found),
        "verdict": str(found.verdict),
        **{str(member): found.decision.of(member) for member in MEMBERS},
        "reasons": [str(reason) for reason in found.decision.reasons],
        "reason_details": found.decision.all_reasons,
    }


def degenerate_row(model: str, error: DegenerateInputError, correspondences: Correspondences, location: str) -> Row:
    """Return the row of an estimator that refused: undetermined, and nothing else known."""
    reasons = degenerate_judgement(error).reasons
    return {
        **dict.fromkeys(schema("calibration").names),
        "correspondences": location,
        "model": model,
        "width": correspondences.width,
        "height": correspondences.height,
        "num_correspondences": correspondences.num,
        **dict.fromkeys(("verdict", *map(str, MEMBERS)), Verdict.UNDETERMINED),
        "reasons": [str(reason) for reason in reasons],
        "reason_details": reasons,
    }


def calibration_table(rows: Sequence[Row]) -> pa.Table:
    """Return the table ``calibration``."""
    wanted = schema("calibration")
    return build_table({name: [row[name] for row in rows] for name in wanted.names}, wanted)


def residuals_table(validations: Sequence[Validation], correspondences: Correspondences) -> pa.Table:
    """Return the table ``calibration_residuals``: every correspondence once per estimate."""
    num, names = correspondences.num, [found.estimate.name for found in validations]
    residuals_px = _stacked([found.estimate.residuals_px for found in validations])
    z = _stacked([_at_inliers(found) for found in validations])
    xy_px = _stacked([correspondences.xy_px] * len(names))
    columns: dict[str, Values | Coded] = {
        "model": Coded(np.repeat(np.arange(len(names), dtype=np.int32), num), names),
        "correspondence_idx": np.tile(np.arange(num), len(names)),
        "is_inlier": np.concatenate([found.estimate.inliers for found in validations] or [np.empty(0, dtype=bool)]),
        "x_px": xy_px[:, 0],
        "y_px": xy_px[:, 1],
        "residual_x_px": residuals_px[:, 0],
        "residual_y_px": residuals_px[:, 1],
        "z_x": z[:, 0],
        "z_y": z[:, 1],
    }
    return build_table(columns, schema("calibration_residuals"))


def _stacked(arrays: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate(arrays) if arrays else np.empty((0, 2))


def _at_inliers(found: Validation) -> FloatArray:
    """Return z (n, 2) of all correspondences, NaN for outliers."""
    z = np.full((len(found.estimate.inliers), 2), math.nan)
    z[found.estimate.inliers] = found.robust.noise.z
    return z


def _camera_columns(estimate: Estimate) -> Row:
    camera = estimate.camera
    colmap = camera.colmap
    k1, k2, k3 = camera.coefficients
    return {
        "model": estimate.name,
        "distortion": str(camera.distortion),
        "camera_model": colmap.model.name if colmap else None,
        "params": colmap.params if colmap else None,
        "estimated": list(camera.estimated),
        "width": camera.width,
        "height": camera.height,
        "fx_px": camera.focal_px[0],
        "fy_px": camera.focal_px[1],
        "cx_px": camera.principal_point_px[0],
        "cy_px": camera.principal_point_px[1],
        "k1": float(k1),
        "k2": float(k2),
        "k3": float(k3),
        "rotation_cam_from_world": estimate.rotation_cam_from_world.ravel(),
        "translation_cam_from_world": estimate.translation_cam_from_world,
    }


def _error_columns(found: Validation) -> Row:
    error = np.hypot(*found.residuals_px.T)
    first, third = found.error_quartiles_px
    return {
        "rms_px": math.sqrt(float((error**2).mean())),
        "mean_px": float(error.mean()),
        "quartile1_px": first,
        "quartile3_px": third,
        "olsson_accepts": found.olsson_accepts,
    }


def _test_columns(found: Validation, alpha: float) -> Row:
    tests, plain = found.robust.tests, found.plain.tests
    return {
        **normality_columns(tests),
        "tests_rejecting": tests_rejecting(tests, alpha),
        "sd_plain_px": found.plain.sd_px,
        "ks_plain_stat": plain.ks_stat,
        "ks_plain_p": plain.ks_p,
        "dap_plain_p": plain.dap_p,
        "sw_plain_p": plain.sw_p,
    }


def tests_rejecting(tests: NormalityTests, alpha: float) -> list[str]:
    """Return which of the paper's three tests reject, by the paper's names."""
    return [name for name, p in (("KS", tests.ks_p), ("DAP", tests.dap_p), ("SW", tests.sw_p)) if p < alpha]


def _evidence_columns(found: Validation) -> Row:
    known, camera = found.identifiability, found.plausibility
    return {
        "pose_offset_px": found.pose_offset_px,
        "sd_focal_px": known.sd_focal_px,
        "sd_focal_rel": known.sd_focal_rel,
        "sd_k1": known.sd_k1,
        "correlation_focal_depth": correlation_focal_depth(found.estimate),
        "singular_share": known.parameters.singular_share,
        "planarity": found.geometry.planarity,
        "plane_tilt_deg": found.geometry.tilt_deg,
        "coverage": found.coverage,
        "occupied_cells": found.occupied_cells,
        "focal_over_size": camera.focal_over_size,
        "folds_over": camera.folds_over,
        "expected_error_px": found.expected_error.median_px,
    }
