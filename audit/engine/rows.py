"""From what is known about images and models to the rows of their tables (columns: audit/table)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.decision.columns import cause_columns, verdict_columns, worth_columns
from sfm_audit.audit.decision.decide import Decision
from sfm_audit.audit.decision.diagnostics import Diagnostics, GroupDiagnostics, OwnDiagnostics, Worth
from sfm_audit.audit.engine.camera import CameraAudit
from sfm_audit.audit.engine.image import ImageAudit
from sfm_audit.audit.engine.jointly import below_diagonal, implied_of, own_diagnostics
from sfm_audit.audit.inliers.stored_errors import StoredErrors
from sfm_audit.audit.joint import CameraStep, JointAudit
from sfm_audit.audit.misfit import GROUPS, MisfitTests
from sfm_audit.audit.noise.standardise import ModelTracks
from sfm_audit.audit.normality import NormalityTests
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.columns import IMPLIED, OUTSIDE_COLUMNS, own_parameter_names
from sfm_audit.audit.table.pose_columns import POSE_COLUMNS
from sfm_audit.audit.table.witnesses import Witness
from sfm_audit.audit.table.words import Member, MisfitGroup, Verdict
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import Finding, SparseModel

Row = dict[str, object]
_NO_OWN_STEPS: Final[Row] = {
    "own_step_px": math.nan,
    **{f"own_{name}_{what}": math.nan for name in own_parameter_names() for what in ("step", "sd")},
}


def image_row(audit: ImageAudit, labels: ModelLabels, noise_name: str) -> Row:
    """Return the row of one image; ``ks_q`` needs all rows of the model and is left NaN."""
    inliers, image, camera = audit.inliers, audit.image, audit.image.camera
    num_inliers = len(inliers.xy_px)
    quality = audit.quality
    lost = inliers.num_behind + inliers.num_nonfinite + inliers.num_dangling
    return {
        **_label_columns(labels),
        "image_id": image.image_id,
        "image_name": image.name,
        "camera_id": image.camera_id,
        "camera_model": camera.model.name if camera else None,
        "width": camera.width if camera else None,
        "height": camera.height if camera else None,
        "params": camera.params if camera else None,
        **dict(zip(("qw", "qx", "qy", "qz"), image.quat_cam_from_world_wxyz.tolist(), strict=True)),
        **dict(zip(("tx", "ty", "tz"), image.translation_cam_from_world.tolist(), strict=True)),
        "median_depth": quality.median_depth if quality else math.nan,
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
        **_joint_misfit_columns(audit),
        "pose_offset_px": audit.pose_offset_px,
        **_camera_columns(audit),
        **own_columns(audit.diagnostics.own),
        **_deciding_columns(audit.diagnostics),
        **{name: audit.implied.get(name, math.nan) for name in IMPLIED},
        **{name: audit.pose.get(name, null) for name, null in POSE_COLUMNS.items()},
        **_outside_columns(audit),
        **verdict_columns(audit.decision),
        **{name: value for name, value in audit.outside.items() if name not in OUTSIDE_COLUMNS},
    }


@lru_cache(maxsize=16)
def _label_columns(labels: ModelLabels) -> Row:
    """Text columns that name the model."""
    return asdict(labels)


def _outside_columns(audit: ImageAudit) -> Row:
    """What witnesses outside of the image measured, and what they said of it."""
    said = audit.diagnostics.testimonies
    return {
        **{name: audit.outside.get(name, null) for name, null in OUTSIDE_COLUMNS.items()},
        "witnesses": None if said is None else [str(each.witness) for each in said],
        "testimonies": None if said is None else list(said),
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


def _joint_misfit_columns(audit: ImageAudit) -> Row:
    """Effect, q and rank of every group in the joint test, and what the named misfit is worth."""
    misfit, found = audit.diagnostics.misfit, audit.misfit
    row: Row = {}
    for group in GROUPS:
        test = misfit.groups[group] if misfit else None
        row[f"misfit_{group}_px_joint"] = test.px if test else math.nan
        row[f"misfit_{group}_q_joint"] = test.q if test else math.nan
        row[f"misfit_{group}_rank_joint"] = test.rank if test else None
    return {
        **row,
        "num_misfit_tested": misfit.num_tested if misfit else None,
        "misfit_details": [_MisfitDetail.of(group, misfit.groups[group]) for group in GROUPS] if misfit else None,
        **worth_columns(found, misfit, audit.constant.sigma_constant_px),
    }


class _MisfitDetail(NamedTuple):
    """An element of ``misfit_details``."""

    group: str
    status: str
    gain: float
    worth_deg: float
    worth_centre: float
    worth_focal_rel: float

    @classmethod
    def of(cls, group: MisfitGroup, test: GroupDiagnostics) -> _MisfitDetail:
        """Return what the table keeps beside px, q and rank; numbers that are not known are NaN."""
        worth = test.worth or Worth(math.nan, math.nan, math.nan)
        gain = test.gain if math.isfinite(test.gain) else math.nan
        return cls(group, test.status, gain, worth.rotation_deg, worth.centre_rel, worth.focal_rel)


def _deciding_columns(diagnostics: Diagnostics) -> Row:
    """The rest of what decides, so that a finished run can be decided again."""
    own, gains, camera = diagnostics.own, diagnostics.gains, diagnostics.camera
    return {
        "own_num_images": own.num_images if own else None,
        "own_sigma_px": own.sigma_px if own else math.nan,
        "own_implied": own.largest.implied if own and own.largest else math.nan,
        "gain_pose": gains.pose if gains else math.nan,
        "gain_camera": gains.camera if gains else math.nan,
        "gain_both": gains.both if gains else math.nan,
        "singular_share": camera.singular_share if camera else math.nan,
        "half_pixel": diagnostics.half_pixel,
    }


def _camera_columns(audit: ImageAudit) -> Row:
    quality, camera = audit.quality, audit.diagnostics.camera
    if quality is None or camera is None:
        numbers = ("sd_focal_px", "sd_focal_rel", "sd_k1")
        names = (*numbers, *(f"{name}_conditional" for name in numbers), "sd_focal_rel_joint", "focal_over_size")
        return {
            **dict.fromkeys((*names, "expected_error_px", "expected_error_px_conditional"), math.nan),
            "folds_over": None,
        }
    known, shape = quality.identifiability, quality.shape
    focals = [shape.camera.params[i] for i in shape.camera.model.focal_idxs]
    sd_focal_px = _sd_of_first_focal(audit.diagnostics.own, shape.camera.model) if camera.is_joint else math.nan
    return {
        "sd_focal_px": sd_focal_px if camera.is_joint and focals else known.sd_focal_px,
        "sd_focal_rel": camera.sd_focal_rel,
        "sd_k1": camera.sd_k1,
        "sd_focal_rel_joint": camera.sd_focal_rel if camera.is_joint else math.nan,
        "sd_focal_px_conditional": known.sd_focal_px,
        "sd_focal_rel_conditional": known.sd_focal_rel,
        "sd_k1_conditional": known.sd_k1,
        "focal_over_size": shape.plausibility.focal_over_size,
        "folds_over": shape.plausibility.folds_over,
        "expected_error_px": audit.expected_error_px if camera.is_joint else quality.expected_error_px,
        "expected_error_px_conditional": quality.expected_error_px,
    }


def _sd_of_first_focal(own: OwnDiagnostics | None, model: CameraModel) -> float:
    first = model.param_names[model.focal_idxs[0]] if model.focal_idxs else ""
    return next((step.sd for step in own.steps if step.name == first), math.nan) if own else math.nan


def own_columns(own: OwnDiagnostics | None) -> Row:
    """Return the joint step of every parameter that some camera model has."""
    row = dict(_NO_OWN_STEPS)
    if own:
        row["own_step_px"] = own.step_px
        for step in own.steps:
            row[f"own_{step.name}_step"], row[f"own_{step.name}_sd"] = step.step, step.sd
    return row


def camera_row(
    audit: CameraAudit, labels: ModelLabels, step: CameraStep | None = None, joint: JointAudit | None = None
) -> Row:
    """Return the row of one camera; ``step``: its own parameters in the joint system, where it takes part."""
    camera = audit.camera
    implied = implied_of(joint.implied, step.camera_idx) if joint and step else {}
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
        **own_columns(own_diagnostics(step, math.nan) if step else None),
        "own_parameters": list(step.names) if step else None,
        "own_correlations": below_diagonal(step.correlation) if step else None,
        **{name: implied.get(name, math.nan) for name in (*IMPLIED, *(f"{name}_sd" for name in IMPLIED))},
        "sd_focal_rel_joint": step.sd_focal_rel if step else math.nan,
        "joint_blocks": joint.num_blocks if joint else None,
        "misfit_material": bool(audit.misfit.material),
    }


def model_row(
    model: SparseModel,
    labels: ModelLabels,
    tracks: ModelTracks,
    errors: StoredErrors,
    findings: Sequence[Finding],
    decisions: Sequence[Decision],
    witnesses: Sequence[Witness] = (),
) -> Row:
    """Return the row of one model; ``decisions`` about its images; ``witnesses`` that were asked of them."""
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
        "witnesses": [str(each) for each in witnesses] or None,
        "findings": list(findings),
    }
