"""From what is known about images and models to the rows of their tables (columns: audit/table)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np

from sfm_audit.audit.decision.columns import cause_columns
from sfm_audit.audit.engine.camera import CameraAudit
from sfm_audit.audit.engine.image_table import OWN_COLUMNS, own_numbers
from sfm_audit.audit.engine.jointly import below_diagonal_of
from sfm_audit.audit.engine.known import ModelFacts
from sfm_audit.audit.inliers.stored_errors import StoredErrors
from sfm_audit.audit.misfit import GROUPS, MisfitTests
from sfm_audit.audit.noise.standardise import ModelTracks
from sfm_audit.audit.normality import NormalityTests
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.columns import IMPLIED
from sfm_audit.audit.table.given import Coded, Column, Listed
from sfm_audit.audit.table.witnesses import Witness
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import Finding, SparseModel

Row = dict[str, object]


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


def misfit_columns(tests: MisfitTests | None) -> Row:
    """Return p, px and rank of every group; the rank only where it is known."""
    row: Row = {}
    for group in GROUPS:
        test = tests[group] if tests else None
        row[f"misfit_{group}_p"] = test.p if test else math.nan
        row[f"misfit_{group}_px"] = test.px if test else math.nan
        row[f"misfit_{group}_rank"] = test.rank if test else None
    return row


def camera_columns(facts: ModelFacts, audits: Sequence[CameraAudit], labels: ModelLabels) -> dict[str, Column]:
    """Return the columns of cameras; facts: that their model's images share."""
    joint = facts.joint
    rows = [int(facts.model.images.camera_idx[audit.image_idxs[0]]) for audit in audits]
    steps = [facts.steps.get(row) for row in rows]
    own = [own_numbers(facts.own.get(row)) for row in rows]
    freed = [facts.implied.get(row, {}) if step else {} for row, step in zip(rows, steps, strict=True)]
    cameras, same = [audit.camera for audit in audits], np.zeros(len(audits), dtype=np.int64)
    tested = [{**misfit_columns(audit.tests), **cause_columns(audit.misfit)} for audit in audits]
    names = {**misfit_columns(None), **cause_columns(None)}
    return {
        **{name: Coded(same, (text,)) for name, text in asdict(labels).items()},
        "camera_id": [camera.camera_id for camera in cameras],
        "camera_model": [camera.model.name for camera in cameras],
        "width": [camera.width for camera in cameras],
        "height": [camera.height for camera in cameras],
        "params": [camera.params for camera in cameras],
        "num_images": [len(audit.image_idxs) for audit in audits],
        "num_points3d": [audit.num_points for audit in audits],
        "num_observations": [audit.num_observations for audit in audits],
        **{name: [each[name] for each in tested] for name in names},
        "advised_camera_model": [audit.advised_camera_model for audit in audits],
        **dict(zip(OWN_COLUMNS, np.array(own).reshape(-1, len(OWN_COLUMNS)).T, strict=True)),
        "own_parameters": [list(step.names) if step else None for step in steps],
        "own_correlations": _correlations([None if step is None else step.correlation for step in steps]),
        **{name: [each.get(name, math.nan) for each in freed] for name in (*IMPLIED, *(f"{n}_sd" for n in IMPLIED))},
        "sd_focal_rel_joint": [step.sd_focal_rel if step else math.nan for step in steps],
        "joint_blocks": [joint.num_blocks if joint else None] * len(audits),
        "misfit_material": np.array([bool(audit.misfit.material) for audit in audits], dtype=bool),
    }


def _correlations(matrices: Sequence[FloatArray | None]) -> Listed:
    """The values below the diagonal of each matrix; null where they are not known."""
    values = [np.empty(0) if each is None else each[below_diagonal_of(len(each))] for each in matrices]
    joined = np.concatenate([np.empty(0), *values])
    offsets = np.concatenate([[0], np.cumsum([each.size for each in values], dtype=np.int64)])
    known = np.array([each is not None for each in matrices], dtype=bool)
    return Listed(offsets, np.ma.masked_array(joined, ~np.isfinite(joined)), known)


def model_row(
    model: SparseModel,
    labels: ModelLabels,
    tracks: ModelTracks,
    errors: StoredErrors,
    findings: Sequence[Finding],
    counts: Mapping[str, int],
    witnesses: Sequence[Witness] = (),
) -> Row:
    """Return the row of one model; ``counts`` of its images' verdicts; ``witnesses`` that were asked of them."""
    total_sq = tracks.statistics.total_sq_px2
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
        **counts,
        "witnesses": [str(each) for each in witnesses] or None,
        "findings": list(findings),
    }
