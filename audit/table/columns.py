"""What do the result tables hold? Name, type, unit and meaning of every column; nothing else in the project knows them.

``docs/tables.md`` is made from this file by ``scripts/make_docs_tables.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import pyarrow as pa

from sfm_audit.audit.table.arrow import build_table
from sfm_audit.audit.table.words import GROUP_MEANINGS, Member, Verdict
from sfm_audit.loaders.camera_models import CAMERA_MODELS

__all__ = [
    "CALIBRATION",
    "CALIBRATION_RESIDUALS",
    "CAMERAS",
    "IMAGES",
    "MODELS",
    "OBSERVATIONS",
    "TABLES",
    "Column",
    "ModelLabels",
    "TableName",
    "build_table",
    "empty_table",
    "schema",
]

TableName = Literal["images", "cameras", "models", "observations", "calibration", "calibration_residuals"]


@dataclass(frozen=True, slots=True)
class Column:
    """One column: ``unit`` is px, deg, count, id, text, bool or 1 (a pure number); ``meaning`` is one line."""

    name: str
    type: pa.DataType
    unit: str
    meaning: str


@dataclass(frozen=True, slots=True)
class ModelLabels:
    """The four text columns that say which model a row belongs to (docs/tables.md)."""

    dataset: str
    scene: str
    component: str
    model_path: str


def _text(name: str, meaning: str) -> Column:
    return Column(name, pa.string(), "text", meaning)


def _list_of(kind: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("element", kind))  # Parquet's name for it: what is read equals what was written


def _texts(name: str, meaning: str) -> Column:
    return Column(name, _list_of(pa.string()), "text", meaning)


def _id(name: str, meaning: str) -> Column:
    return Column(name, pa.uint32(), "id", meaning)


def _count(name: str, meaning: str) -> Column:
    return Column(name, pa.int64(), "count", meaning)


def _bool(name: str, meaning: str) -> Column:
    return Column(name, pa.bool_(), "bool", meaning)


def _px(name: str, meaning: str) -> Column:
    return Column(name, pa.float64(), "px", meaning)


def _number(name: str, meaning: str) -> Column:
    return Column(name, pa.float64(), "1", meaning)


_IDENTITY: Final = (
    _text("dataset", "base name of the PATH that was given"),
    _text("scene", "scene the model belongs to; base name of a bare model folder"),
    _text("component", "which of the scene's models; 0 for a bare model folder"),
    _text("model_path", "location of the model as given, joined with the path below it"),
)


def _misfit_groups() -> tuple[Column, ...]:
    out = []
    for group, words in GROUP_MEANINGS.items():
        out += [
            _number(f"misfit_{group}_p", f"p-value of the score test for {words}, on the model as it stands"),
            _px(f"misfit_{group}_px", f"RMS length of the field of {words} in the residuals, cleaned of noise"),
            _count(f"misfit_{group}_rank", "free columns of the group; 0: the camera model has it already"),
        ]
    return tuple(out)


def _misfit() -> tuple[Column, ...]:
    return (
        *_misfit_groups(),
        _text("misfit_group", "named cause among the significant groups; for images of the joint test"),
        _px("misfit_px", "effect of misfit_group"),
        _number("misfit_q", "q-value of misfit_group: Holm over the groups, Benjamini-Hochberg over the model"),
        _text("advised_camera_model", "smallest COLMAP model that holds what was found, or none: and what it is"),
    )


REASON_DETAIL: Final = pa.struct(
    [
        ("code", pa.string()),
        ("verdict", pa.string()),
        ("value", pa.float64()),
        ("limit", pa.float64()),
        ("unit", pa.string()),
        ("group", pa.string()),
        ("text", pa.string()),
    ]
)
"""One reason: its code, the verdict it speaks for, the number that triggered it, its limit, and the same in words."""


def _joint_misfit() -> tuple[Column, ...]:
    out = []
    for group, words in GROUP_MEANINGS.items():
        out += [
            _px(f"misfit_{group}_px_joint", f"RMS length of the field of {words} that nothing else could take up"),
            _number(f"misfit_{group}_q_joint", f"q-value of the joint test for {words}"),
            _count(f"misfit_{group}_rank_joint", f"free directions of {words} in the joint test"),
        ]
    return (
        *out,
        _number("misfit_px_sigma", "misfit_px / sigma_constant_px"),
        Column("misfit_worth_deg", pa.float64(), "deg", "rotation of the image if misfit_group were admitted"),
        _number("misfit_worth_centre", "shift of its centre then, in units of the median depth"),
        _number("misfit_worth_focal_rel", "relative change of its focal length then"),
    )


def _own_steps() -> tuple[Column, ...]:
    out = [_px("own_step_px", "what freeing the camera's own parameters alone would gain in the joint system")]
    for name in own_parameter_names():
        out += [
            _number(f"own_{name}_step", f"change of {name} that adjusting everything would make, in its unit"),
            _number(f"own_{name}_sd", f"standard deviation of {name} in the joint system"),
        ]
    return (*out, *(_number(name, f"{words}, had it alone been freed") for name, words in IMPLIED.items()))


def own_parameter_names() -> tuple[str, ...]:
    """Return the names of all parameters that COLMAP refines by default, in the order of its models."""
    fixed = {"cx", "cy", "w", "h"}
    return tuple(dict.fromkeys(name for model in CAMERA_MODELS for name in model.param_names if name not in fixed))


IMPLIED: Final = {
    "implied_cx": "change of the principal point, px",
    "implied_cy": "change of the principal point, px",
    "implied_radial": "next radial coefficient that the model lacks",
    "implied_aspect": "fx / fy - 1 where the model has one focal length",
    "implied_p1": "first tangential coefficient where the model has none",
    "implied_p2": "second tangential coefficient where the model has none",
}
"""Columns of parameters that nobody freed (method.md section 11)."""

IMAGES: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    _id("image_id", "id as stored"),
    _text("image_name", "name as stored"),
    _id("camera_id", "id as stored"),
    _text("camera_model", "COLMAP's name of the camera model; null when the model has no such camera"),
    Column("width", pa.uint32(), "px", "image width as stored with the camera"),
    Column("height", pa.uint32(), "px", "image height as stored with the camera"),
    Column("params", _list_of(pa.float64()), "px and 1", "camera parameters as stored, in COLMAP's order"),
    _count("num_points2d", "all 2D points of the image, linked or not"),
    _count("num_linked", "2D points with a 3D point id = num_inliers + num_behind + num_nonfinite + num_dangling"),
    _count("num_inliers", "observations that enter the audit (point exists, before the camera, finite projection)"),
    _count("num_behind", "linked points behind the camera"),
    _count("num_nonfinite", "linked points whose projection is not finite"),
    _count("num_dangling", "2D points that name a 3D point the model does not have"),
    _count("num_unverifiable", "inliers that their own track cannot verify (audited length < 3 or leverage too high)"),
    _count("num_standardised", "observations that enter the tests, x and y each = num_inliers - num_unverifiable"),
    _number("mean_track_length", "mean audited track length over the inliers"),
    _number("coverage", "area of the convex hull of the observed inliers / image area, not clipped"),
    _count("occupied_cells", "cells with at least one inlier, of a grid over the image (8 x 8 unless configured)"),
    _px("rms_px", "root mean square reprojection error, sqrt(mean |eps|^2), over the inliers"),
    _px("mean_px", "mean reprojection error |eps| over the inliers"),
    _px("median_px", "median reprojection error |eps| over the inliers"),
    _px("p95_px", "95th percentile of the reprojection error |eps| over the inliers"),
    _px("max_px", "largest reprojection error |eps| among the inliers"),
    _text("noise_model", "noise model behind z: track, constant or keypoint"),
    _px("sigma_constant_px", "robust noise per axis of the raw residuals, one value for the whole image"),
    _px("sigma_d_px", "detector noise per axis, sqrt(theta_1) of the paper's model on whitened residuals"),
    _number("sigma_l", "share of the rest of the track's noise, sqrt(theta_2) of the paper's model"),
    _px("sigma_predicted_px", "median predicted noise per axis of the image's observations"),
    _number("scale_ratio", "observed / predicted noise variance; below 1 over-fitted, above 1 under-fitted"),
    _bool("noise_converged", "whether the robust fits of the noise converged"),
    _number("ks_stat", "Kolmogorov-Smirnov distance of z from N(0, 1)"),
    _number("ks_p", "p-value of ks_stat; the paper's decision is at 0.05"),
    _number("ks_q", "Benjamini-Hochberg q-value of ks_p over the model's images"),
    _number("ks_fitted_p", "p-value of the same distance after centring and scaling z (Lilliefors' null)"),
    _number("ks_norm_p", "p-value of |z|^2 against the Rayleigh law, scale fitted (Lilliefors' exponential null)"),
    _number(
        "ks_norm_unscaled_p",
        "p-value of |z|^2 / 2 against Exp(1), nothing fitted (the paper's own use of z, with noise constant)",
    ),
    _number("dap_stat", "D'Agostino-Pearson statistic of z"),
    _number("dap_p", "p-value of dap_stat"),
    _number("sw_stat", "Shapiro-Wilk statistic of z, at most 5000 values (every k-th observation above that)"),
    _number("sw_p", "p-value of sw_stat"),
    _number("skewness", "skewness of z; 0 for a normal"),
    _number("kurtosis_excess", "excess kurtosis of z; 0 for a normal, positive for heavy tails"),
    _number("ks_constant_stat", "Kolmogorov-Smirnov distance under the constant noise model"),
    _number("ks_constant_p", "p-value of ks_constant_stat"),
    _number("ks_fitted_constant_p", "ks_fitted_p under the constant noise model"),
    _number("ks_norm_constant_p", "ks_norm_p under the constant noise model"),
    _number("dap_constant_p", "dap_p under the constant noise model"),
    _number("sw_constant_p", "sw_p under the constant noise model"),
    _number("skewness_constant", "skewness under the constant noise model"),
    _number("kurtosis_constant", "excess kurtosis under the constant noise model"),
    *_misfit(),
    *_joint_misfit(),
    _px("pose_offset_px", "RMS residual that a change of this image's pose alone would remove; ~0 after adjustment"),
    _px("sd_focal_px", "standard deviation of the first focal length in the joint system; real errors are about 5 x"),
    _number("sd_focal_rel", "largest sd_f / f in the joint system; null where f is not identified"),
    _number("sd_k1", "standard deviation of the first distortion parameter in the joint system"),
    _number("sd_focal_rel_joint", "the same as sd_focal_rel; null where the image takes no part in the joint system"),
    _px("sd_focal_px_conditional", "sd of the first focal length, conditional on the points: a lower bound"),
    _number("sd_focal_rel_conditional", "largest sd_f / f, conditional on the points: a lower bound"),
    _number("sd_k1_conditional", "sd of the first distortion parameter, conditional on the points: a lower bound"),
    *_own_steps(),
    _number("focal_over_size", "first focal length / max(width, height)"),
    _bool("folds_over", "whether the distortion folds inside the image"),
    _px("expected_error_px", "expected error of a measurement with this camera and pose, median over a 16 x 16 grid"),
    _px("expected_error_px_conditional", "the same, conditional on the points: a lower bound"),
    _text("verdict", "accepted, rejected or undetermined under the policy of the run"),
    _text("verdict_ks", "rejected when ks_p < alpha; undetermined with too few standardised observations"),
    _text("verdict_misfit", "rejected when a group has q < alpha and an effect above min_effect in the joint test"),
    _text("verdict_pose", "rejected when pose_offset_px is above its threshold"),
    _text("plausible", "rejected when this cannot be a camera, undetermined when the image says too little of it"),
    _text("verdict_camera", "rejected when its own parameters are not at their optimum, or parts do not fit together"),
    _text("verdict_noise", "rejected when the noise is visibly another one: ks_stat - 1.36 / sqrt(N) above 0.03"),
    _text("verdict_outside", "rejected when witnesses outside of the image disagree; null where none was asked"),
    _text("severity", "of a rejection: hard, medium or weak; null where no member rejects"),
    _texts("reasons", "why not accepted, and remarks: code, colon, and the number that triggered it"),
    Column("reason_details", _list_of(REASON_DETAIL), "text", "reasons of all verdicts, the policy's or not"),
)

CAMERAS: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    _id("camera_id", "id as stored"),
    _text("camera_model", "COLMAP's name of the camera model"),
    Column("width", pa.uint32(), "px", "image width as stored"),
    Column("height", pa.uint32(), "px", "image height as stored"),
    Column("params", _list_of(pa.float64()), "px and 1", "camera parameters as stored, in COLMAP's order"),
    _count("num_images", "images of this camera with inliers"),
    _count("num_points3d", "3D points that they see"),
    _count("num_observations", "their inliers"),
    *_misfit(),
    *_own_steps(),
    *(_number(f"{name}_sd", f"standard deviation of {name}") for name in IMPLIED),
    _number("sd_focal_rel_joint", "largest sd_f / f in the joint system"),
    _count("joint_blocks", "blocks in which the joint system was solved; 1: whole"),
    _bool("misfit_material", "whether misfit_group has q < alpha and an effect above min_effect"),
)

_FINDING: Final = pa.struct([("code", pa.string()), ("count", pa.int64()), ("text", pa.string())])

_ORDER_OF_COUNTS: Final = (  # the first four as version 0.1.0 has them
    *(Member.KS, Member.MISFIT, Member.POSE, Member.PLAUSIBLE),
    *(Member.CAMERA, Member.NOISE, Member.OUTSIDE),
)

MODELS: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    _text("file_format", "format of the model's files; binary and text are COLMAP's"),
    _count("num_cameras", "cameras in the model, used or not"),
    _count("num_images", "registered images"),
    _count("num_points3d", "3D points"),
    _count("num_observations", "linked 2D points of all images"),
    _px("stored_error_px", "mean of the reprojection errors stored with the 3D points"),
    _px("recomputed_point_error_px", "the same mean over points, recomputed"),
    _px("recomputed_observation_error_px", "mean recomputed reprojection error over observations"),
    _number(
        "share_stale_point_errors",
        "share of points whose stored error differs from the recomputed one by more than 1e-3 px and 0.1 %",
    ),
    _number("noise_nu0", "degrees of freedom of the spread of noise between tracks; large = all tracks alike"),
    _px("noise_s0_px", "typical noise of a track per axis"),
    _number("removable_share", "share of the squared residuals that moving the 3D points alone would remove"),
    _count("num_nonstationary_images", "images with a pose_offset_px above the threshold"),
    _count("num_accepted", "images whose verdict is accepted"),
    _count("num_rejected", "images whose verdict is rejected"),
    _count("num_undetermined", "images whose verdict is undetermined"),
    *(
        _count(f"num_{verdict}_{member.short}", f"images whose {member} is {verdict}")
        for member in _ORDER_OF_COUNTS
        for verdict in Verdict
    ),
    Column("findings", _list_of(_FINDING), "text", "inconsistencies of the model: code, how many items, one line each"),
)

_CODED_TEXT: Final = pa.dictionary(pa.int32(), pa.string())  # millions of rows, few different texts

OBSERVATIONS: Final[tuple[Column, ...]] = (
    *(Column(column.name, _CODED_TEXT, column.unit, column.meaning) for column in _IDENTITY),
    _id("image_id", "id as stored"),
    Column("image_name", _CODED_TEXT, "text", "name as stored"),
    Column("point2d_idx", pa.int64(), "id", "position among the image's 2D points as stored, from 0"),
    Column("point3d_id", pa.uint64(), "id", "id of its 3D point as stored"),
    _px("x_px", "observed; the centre of the first pixel is 0.5"),
    _px("y_px", "observed; the centre of the first pixel is 0.5"),
    _px("residual_x_px", "observed - projected"),
    _px("residual_y_px", "observed - projected"),
    _count("track_length", "audited observations of its 3D point"),
    _number("z_x", "standardised residual under noise_model of the image; null where its track cannot verify it"),
    _number("z_y", "standardised residual under noise_model of the image; null where its track cannot verify it"),
)

CALIBRATION: Final[tuple[Column, ...]] = (
    _text("correspondences", "location of the correspondences as given"),
    _text("model", "estimator and model: D1, D3, pnprf, colmap"),
    _text(
        "distortion", "forward: distorted = undistorted (1 + k1 r^2 ...); division: undistorted = distorted / (1 + ...)"
    ),
    _text("camera_model", "COLMAP's name of the same camera; null where COLMAP has none"),
    Column("params", _list_of(pa.float64()), "px and 1", "parameters of camera_model, in COLMAP's order"),
    _texts("estimated", "parameters that were estimated beside the pose; f moves fx and fy alike"),
    Column("width", pa.uint32(), "px", "image width"),
    Column("height", pa.uint32(), "px", "image height"),
    _px("fx_px", "focal length in x"),
    _px("fy_px", "focal length in y"),
    _px("cx_px", "principal point; the centre of the first pixel is 0.5"),
    _px("cy_px", "principal point; the centre of the first pixel is 0.5"),
    _number("k1", "first coefficient of the distortion; which way it acts says distortion"),
    _number("k2", "second coefficient of the distortion"),
    _number("k3", "third coefficient of the distortion"),
    Column("rotation_cam_from_world", _list_of(pa.float64()), "1", "nine numbers, row by row"),
    Column("translation_cam_from_world", _list_of(pa.float64()), "model units", "three numbers"),
    _count("num_correspondences", "correspondences given"),
    _count("num_inliers", "correspondences that the estimator kept; all that follows is about them"),
    _px("rms_px", "root mean square reprojection error, sqrt(mean |eps|^2)"),
    _px("mean_px", "mean reprojection error |eps|"),
    _px("quartile1_px", "first quartile of the reprojection error |eps|"),
    _px("quartile3_px", "third quartile of the reprojection error |eps|"),
    _bool("olsson_accepts", "baseline, Olsson's rule: mean_px lies between quartile1_px and quartile3_px"),
    _text("noise_model", "noise model behind z: constant or lidar"),
    _px("sd_px", "empirical standard deviation per axis, sqrt(mean eps^2), x and y pooled"),
    _px("sd_predicted_px", "what the noise model predicts for sd_px: root mean square of its standard deviations"),
    _px("sigma_constant_px", "robust noise per axis, one value for the whole image"),
    _px("sigma_d_px", "detector noise per axis, sqrt(theta_1) of the paper's model"),
    _number("sigma_l", "lidar noise in steps to the scan's neighbours, sqrt(theta_2) of the paper's model"),
    _bool("noise_converged", "whether the robust fits of the noise converged"),
    _number("ks_stat", "Kolmogorov-Smirnov distance of z from N(0, 1)"),
    _number("ks_p", "p-value of ks_stat; the paper's decision is at 0.05"),
    _number("ks_fitted_p", "p-value of the same distance after centring and scaling z (Lilliefors' null)"),
    _number("ks_norm_p", "p-value of |z|^2 against the Rayleigh law, scale fitted (Lilliefors' exponential null)"),
    _number("ks_norm_unscaled_p", "p-value of |z|^2 / 2 against Exp(1), nothing fitted"),
    _number("dap_stat", "D'Agostino-Pearson statistic of z"),
    _number("dap_p", "p-value of dap_stat"),
    _number("sw_stat", "Shapiro-Wilk statistic of z"),
    _number("sw_p", "p-value of sw_stat"),
    _number("skewness", "skewness of z; 0 for a normal"),
    _number("kurtosis_excess", "excess kurtosis of z; 0 for a normal, positive for heavy tails"),
    _texts("tests_rejecting", "which of KS, DAP, SW have p < alpha"),
    _px("sd_plain_px", "sd_predicted_px under the plain scale: maximum likelihood, not robust"),
    _number("ks_plain_stat", "Kolmogorov-Smirnov distance under the plain scale, which hides tails"),
    _number("ks_plain_p", "p-value of ks_plain_stat"),
    _number("dap_plain_p", "dap_p under the plain scale"),
    _number("sw_plain_p", "sw_p under the plain scale"),
    *_misfit_groups(),
    _text("misfit_group", "named cause among the significant groups"),
    _px("misfit_px", "effect of misfit_group"),
    _number("misfit_q", "p-value of misfit_group, Holm over the groups that ran"),
    _px("tau_px", "effect below which a significant misfit does not reject"),
    _px("pose_offset_px", "RMS residual that a change of the pose alone would remove; ~0 at an optimum"),
    _px("sd_focal_px", "standard deviation of the (first) focal length, the 3D points taken as exact"),
    _number("sd_focal_rel", "largest sd_f / f, the 3D points taken as exact"),
    _number("sd_k1", "standard deviation of k1, the 3D points taken as exact"),
    _number("correlation_focal_depth", "correlation of the focal length with the distance; +-1: not told apart"),
    _number("singular_share", "smallest / largest singular value of the unit Jacobian columns; ~0: ill-conditioned"),
    _number("planarity", "smallest / largest singular value of the centred 3D points; 0: on a plane"),
    Column("plane_tilt_deg", pa.float64(), "deg", "angle of the points' plane with the image; 0: fronto-parallel"),
    _number("coverage", "area of the convex hull of the observed inliers / image area, not clipped"),
    _count("occupied_cells", "cells with at least one inlier, of an 8 x 8 grid over the image"),
    _number("focal_over_size", "first focal length / max(width, height)"),
    _bool("folds_over", "whether the distortion folds inside the image"),
    _px("expected_error_px", "expected error of a measurement with this camera and pose, median over a 16 x 16 grid"),
    _px("expected_error_px_conditional", "the same, conditional on the points: a lower bound"),
    _text("verdict", "accepted, rejected or undetermined under the policy"),
    _text("verdict_ks", "rejected when ks_p < alpha"),
    _text("verdict_misfit", "rejected when a group has p < alpha (Holm) and an effect above tau_px"),
    _text("verdict_pose", "rejected when pose_offset_px is above its threshold"),
    _text("plausible", "rejected when this cannot be a camera, undetermined when the points say too little of it"),
    _texts("reasons", "why not accepted, and remarks: code, colon, and the number that triggered it"),
    Column("reason_details", _list_of(REASON_DETAIL), "text", "reasons of all verdicts, the policy's or not"),
)

CALIBRATION_RESIDUALS: Final[tuple[Column, ...]] = (
    Column("model", _CODED_TEXT, "text", "estimator and model, as in calibration"),
    Column("correspondence_idx", pa.int64(), "id", "position among the correspondences as given, from 0"),
    _bool("is_inlier", "whether the estimator kept it"),
    _px("x_px", "observed; the centre of the first pixel is 0.5"),
    _px("y_px", "observed; the centre of the first pixel is 0.5"),
    _px("residual_x_px", "observed - projected; null where the camera does not see the point"),
    _px("residual_y_px", "observed - projected; null where the camera does not see the point"),
    _number("z_x", "standardised residual under noise_model; null for outliers"),
    _number("z_y", "standardised residual under noise_model; null for outliers"),
)

TABLES: Final[dict[TableName, tuple[Column, ...]]] = {
    "images": IMAGES,
    "cameras": CAMERAS,
    "models": MODELS,
    "observations": OBSERVATIONS,
    "calibration": CALIBRATION,
    "calibration_residuals": CALIBRATION_RESIDUALS,
}


def schema(table: TableName) -> pa.Schema:
    """Return the Arrow schema of a table; each field's metadata holds its unit and meaning."""
    return pa.schema(
        [
            pa.field(column.name, column.type, metadata={"unit": column.unit, "meaning": column.meaning})
            for column in TABLES[table]
        ]
    )


def empty_table(table: TableName) -> pa.Table:
    """Return a table without rows."""
    wanted = schema(table)
    return build_table({name: [] for name in wanted.names}, wanted)
