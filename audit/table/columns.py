"""What do the result tables hold? Name, type, unit and meaning of every column; nothing else in the project knows them.

``docs/tables.md`` is made from this file by ``scripts/make_docs_tables.py``.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, Literal

from sfm_audit.audit.table.calibration import CALIBRATION, CALIBRATION_RESIDUALS
from sfm_audit.audit.table.diagnoses import DIAGNOSIS
from sfm_audit.audit.table.kinds import (
    MISFIT_DETAIL,
    REASON_DETAIL,
    TESTIMONY,
    Column,
    count,
    flag,
    misfit,
    number,
    px,
    stored_id,
    text,
    texts,
)
from sfm_audit.audit.table.pose_columns import POSE
from sfm_audit.audit.table.types import CODED_TEXT, DOUBLE, INT64, TEXT, UINT32, UINT64, list_of, struct_of
from sfm_audit.audit.table.words import GROUP_MEANINGS, Member, Verdict
from sfm_audit.loaders.camera_models import CAMERA_MODELS

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pyarrow as pa

    from sfm_audit.audit.table.given import Column as Given

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
class ModelLabels:
    """The four text columns that say which model a row belongs to (docs/tables.md)."""

    dataset: str
    scene: str
    component: str
    model_path: str


_IDENTITY: Final = (
    text("dataset", "base name of the PATH that was given"),
    text("scene", "scene the model belongs to; base name of a bare model folder"),
    text("component", "which of the scene's models; 0 for a bare model folder"),
    text("model_path", "location of the model as given, joined with the path below it"),
)


def _joint_misfit() -> tuple[Column, ...]:
    out = []
    for group, words in GROUP_MEANINGS.items():
        out += [
            px(f"misfit_{group}_px_joint", f"RMS length of the field of {words} that nothing else could take up"),
            number(f"misfit_{group}_q_joint", f"q-value of the joint test for {words}"),
            count(f"misfit_{group}_rank_joint", f"free directions of {words} in the joint test"),
        ]
    return (
        *out,
        count("num_misfit_tested", "inliers behind the joint test; null without inliers"),
        Column(
            "misfit_details", list_of(MISFIT_DETAIL), "text", "every group in the joint test: status, BIC gain, worth"
        ),
        number("misfit_px_sigma", "misfit_px / sigma_constant_px"),
        Column("misfit_worth_deg", DOUBLE, "deg", "rotation of the image if misfit_group were admitted"),
        number("misfit_worth_centre", "shift of its centre then, in units of the median depth"),
        number("misfit_worth_focal_rel", "relative change of its focal length then"),
    )


def _own_steps() -> tuple[Column, ...]:
    out = [px("own_step_px", "what freeing the camera's own parameters alone would gain in the joint system")]
    for name in own_parameter_names():
        out += [
            number(f"own_{name}_step", f"change of {name} that adjusting everything would make, in its unit"),
            number(f"own_{name}_sd", f"standard deviation of {name} in the joint system"),
        ]
    return (*out, *(number(name, f"{words}, had it alone been freed") for name, words in IMPLIED.items()))


@cache
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

_OUTSIDE: Final = (
    count("num_pairs_strong", "its verified pairs of at least 60 matches; null without a database (--database)"),
    count("num_pairs_contradicting", "of these, pairs that the two cameras contradict in most of their matches"),
    count("num_pairs_covisible", "of its strong pairs, those with images that share at least 15 points with it"),
    count("num_pairs_covisible_contradicting", "of these, contradicting ones"),
    number("pairs_p", "p-value of so many contradicting covisible pairs under the rate of the model's other pairs"),
    number("pairs_q", "Benjamini-Hochberg q-value of pairs_p over the model's images"),
    count("num_neighbours", "images that share at least 15 points with it"),
    count("num_shared_strongest", "points that it shares with its strongest neighbour"),
    count("covisible_part", "which part of the model it is in at 15 shared points; 0 is the largest"),
    flag("is_articulation", "whether the model falls apart without it"),
    px("rig_offset_px", "what moving it alone, against its frame, would remove; null where no rig places it"),
    number("fold_score", "of the model: share of common points that close images of different fold_group lack"),
    count("fold_group", "1 or 2: side of the image if the model is folded; null where no sides can be told apart"),
)
ColumnGroup = Literal["reference", "priors"]

GROUP_COLUMNS: Final[dict[ColumnGroup, tuple[Column, ...]]] = {
    "reference": (
        number("reference_centre_error", "distance of its centre from the reference's, in units of the reference"),
        number("reference_centre_rel", "the same in median depths of the model"),
        Column("reference_rotation_deg", DOUBLE, "deg", "angle between its rotation and the reference's"),
        count("reference_fragment", "0 the main group, 1.. images that moved together; null alone or not known"),
    ),
    "priors": (
        number("prior_distance", "distance of its centre from its position prior, in units of the priors (m of GPS)"),
        number("prior_chi2", "its square in units of the covariance, the fit's share taken into account"),
        number("prior_p", "p-value of prior_chi2: chi^2 with 3 degrees of freedom"),
        number("prior_q", "Benjamini-Hochberg q-value of prior_p over the model's images"),
    ),
}
"""Columns of the images table that exist only where a reference (--reference) or priors (--priors) were given."""

OUTSIDE_COLUMNS: Final = {column.name: math.nan if column.kind == DOUBLE else None for column in _OUTSIDE}
"""What witnesses outside of the image measure, and what stands there where they measured nothing."""

IMAGES: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    stored_id("image_id", "id as stored"),
    text("image_name", "name as stored"),
    stored_id("camera_id", "id as stored"),
    text("camera_model", "COLMAP's name of the camera model; null when the model has no such camera"),
    Column("width", UINT32, "px", "image width as stored with the camera"),
    Column("height", UINT32, "px", "image height as stored with the camera"),
    Column("params", list_of(DOUBLE), "px and 1", "camera parameters as stored, in COLMAP's order"),
    *(number(f"q{axis}", f"{axis} of the rotation camera from world, a quaternion as stored") for axis in "wxyz"),
    *(number(f"t{axis}", f"{axis} of the translation camera from world, model units") for axis in "xyz"),
    number("median_depth", "median depth of the inliers, model units"),
    count("num_points2d", "all 2D points of the image, linked or not"),
    count("num_linked", "2D points with a 3D point id = num_inliers + num_behind + num_nonfinite + num_dangling"),
    count("num_inliers", "observations that enter the audit (point exists, before the camera, finite projection)"),
    count("num_behind", "linked points behind the camera"),
    count("num_nonfinite", "linked points whose projection is not finite"),
    count("num_dangling", "2D points that name a 3D point the model does not have"),
    count("num_unverifiable", "inliers that their own track cannot verify (audited length < 3 or leverage too high)"),
    count("num_standardised", "observations that enter the tests, x and y each = num_inliers - num_unverifiable"),
    number("mean_track_length", "mean audited track length over the inliers"),
    number("coverage", "area of the convex hull of the observed inliers / image area, not clipped"),
    count("occupied_cells", "cells with at least one inlier, of a grid over the image (8 x 8 unless configured)"),
    px("rms_px", "root mean square reprojection error, sqrt(mean |eps|^2), over the inliers"),
    px("mean_px", "mean reprojection error |eps| over the inliers"),
    px("median_px", "median reprojection error |eps| over the inliers"),
    px("p95_px", "95th percentile of the reprojection error |eps| over the inliers"),
    px("max_px", "largest reprojection error |eps| among the inliers"),
    text("noise_model", "noise model behind z: track, constant or keypoint"),
    px("sigma_constant_px", "robust noise per axis of the raw residuals, one value for the whole image"),
    px("sigma_d_px", "detector noise per axis, sqrt(theta_1) of the paper's model on whitened residuals"),
    number("sigma_l", "share of the rest of the track's noise, sqrt(theta_2) of the paper's model"),
    px("sigma_predicted_px", "median predicted noise per axis of the image's observations"),
    number("scale_ratio", "observed / predicted noise variance; below 1 over-fitted, above 1 under-fitted"),
    flag("noise_converged", "whether the robust fits of the noise converged"),
    number("ks_stat", "Kolmogorov-Smirnov distance of z from N(0, 1)"),
    number("ks_p", "p-value of ks_stat; the paper's decision is at 0.05"),
    number("ks_q", "Benjamini-Hochberg q-value of ks_p over the model's images"),
    number("ks_fitted_p", "p-value of the same distance after centring and scaling z (Lilliefors' null)"),
    number("ks_norm_p", "p-value of |z|^2 against the Rayleigh law, scale fitted (Lilliefors' exponential null)"),
    number(
        "ks_norm_unscaled_p",
        "p-value of |z|^2 / 2 against Exp(1), nothing fitted (the paper's own use of z, with noise constant)",
    ),
    number("dap_stat", "D'Agostino-Pearson statistic of z"),
    number("dap_p", "p-value of dap_stat"),
    number("sw_stat", "Shapiro-Wilk statistic of z, at most 5000 values (every k-th observation above that)"),
    number("sw_p", "p-value of sw_stat"),
    number("skewness", "skewness of z; 0 for a normal"),
    number("kurtosis_excess", "excess kurtosis of z; 0 for a normal, positive for heavy tails"),
    number("ks_constant_stat", "Kolmogorov-Smirnov distance under the constant noise model"),
    number("ks_constant_p", "p-value of ks_constant_stat"),
    number("ks_fitted_constant_p", "ks_fitted_p under the constant noise model"),
    number("ks_norm_constant_p", "ks_norm_p under the constant noise model"),
    number("dap_constant_p", "dap_p under the constant noise model"),
    number("sw_constant_p", "sw_p under the constant noise model"),
    number("skewness_constant", "skewness under the constant noise model"),
    number("kurtosis_constant", "excess kurtosis under the constant noise model"),
    *misfit(),
    *_joint_misfit(),
    px("pose_offset_px", "RMS residual that a change of this image's pose alone would remove; ~0 after adjustment"),
    px("sd_focal_px", "standard deviation of the first focal length in the joint system; real errors are about 5 x"),
    number("sd_focal_rel", "largest sd_f / f in the joint system; null where f is not identified"),
    number("sd_k1", "standard deviation of the first distortion parameter in the joint system"),
    number("sd_focal_rel_joint", "the same as sd_focal_rel; null where the image takes no part in the joint system"),
    px("sd_focal_px_conditional", "sd of the first focal length, conditional on the points: a lower bound"),
    number("sd_focal_rel_conditional", "largest sd_f / f, conditional on the points: a lower bound"),
    number("sd_k1_conditional", "sd of the first distortion parameter, conditional on the points: a lower bound"),
    *_own_steps(),
    count("own_num_images", "images of the camera in the joint system; null where this one takes no part"),
    px("own_sigma_px", "their median sigma_constant_px"),
    number("own_implied", "implied value of the own parameter whose step is most of its standard deviations"),
    number("gain_pose", "what freeing the image's pose alone would gain in the joint system, in units of the noise"),
    number("gain_camera", "what freeing its camera's own parameters alone would gain"),
    number("gain_both", "what freeing both would gain"),
    number("singular_share", "smallest / largest singular value of the unit columns of pose and camera; ~0: singular"),
    flag("half_pixel", "whether its 2D points, and those of most images, are shifted by (0.5, 0.5) px"),
    number("focal_over_size", "first focal length / max(width, height)"),
    flag("folds_over", "whether the distortion folds inside the image"),
    px("expected_error_px", "expected error of a measurement with this camera and pose, median over a 16 x 16 grid"),
    px("expected_error_px_conditional", "the same, conditional on the points: a lower bound"),
    *POSE,
    *_OUTSIDE,
    texts("witnesses", "witnesses outside of the image that said something of it; null where none was asked"),
    Column("testimonies", list_of(TESTIMONY), "text", "what they said; null where none was asked"),
    text("verdict", "accepted, rejected or undetermined under the policy of the run"),
    text("verdict_ks", "rejected when ks_p < alpha; undetermined with too few standardised observations"),
    text("verdict_misfit", "rejected when a group has q < alpha and an effect above min_effect in the joint test"),
    text("verdict_pose", "rejected when pose_offset_px is above its threshold"),
    text("plausible", "rejected when this cannot be a camera, undetermined when the image says too little of it"),
    text("verdict_camera", "rejected when its own parameters are not at their optimum, or parts do not fit together"),
    text("verdict_noise", "rejected when the noise is visibly another one: ks_stat - 1.36 / sqrt(N) above 0.03"),
    text("verdict_outside", "what witnesses outside of the image make of it; null where none could say anything"),
    text("severity", "of a rejection: hard, medium or weak; null where no member rejects"),
    texts("reasons", "why not accepted, and remarks: code, colon, and the number that triggered it"),
    Column("reason_details", list_of(REASON_DETAIL), "text", "reasons of all verdicts, the policy's or not"),
)

CAMERAS: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    stored_id("camera_id", "id as stored"),
    text("camera_model", "COLMAP's name of the camera model"),
    Column("width", UINT32, "px", "image width as stored"),
    Column("height", UINT32, "px", "image height as stored"),
    Column("params", list_of(DOUBLE), "px and 1", "camera parameters as stored, in COLMAP's order"),
    count("num_images", "images of this camera with inliers"),
    count("num_points3d", "3D points that they see"),
    count("num_observations", "their inliers"),
    *misfit(),
    *_own_steps(),
    texts("own_parameters", "its own parameters, those that COLMAP refines; null where it takes no part"),
    Column(
        "own_correlations",
        list_of(DOUBLE),
        "1",
        "correlations of own_parameters in the joint system, below the diagonal, row by row",
    ),
    *(number(f"{name}_sd", f"standard deviation of {name}") for name in IMPLIED),
    number("sd_focal_rel_joint", "largest sd_f / f in the joint system"),
    count("joint_blocks", "blocks in which the joint system was solved; 1: whole"),
    flag("misfit_material", "whether misfit_group has q < alpha and an effect above min_effect"),
)

_FINDING: Final = struct_of(code=TEXT, count=INT64, text=TEXT)

_ORDER_OF_COUNTS: Final = (  # the first four as version 0.1.0 has them
    *(Member.KS, Member.MISFIT, Member.POSE, Member.PLAUSIBLE),
    *(Member.CAMERA, Member.NOISE, Member.OUTSIDE),
)

MODELS: Final[tuple[Column, ...]] = (
    *_IDENTITY,
    text("file_format", "format of the model's files; binary and text are COLMAP's"),
    count("num_cameras", "cameras in the model, used or not"),
    count("num_images", "registered images"),
    count("num_points3d", "3D points"),
    count("num_observations", "linked 2D points of all images"),
    px("stored_error_px", "mean of the reprojection errors stored with the 3D points"),
    px("recomputed_point_error_px", "the same mean over points, recomputed"),
    px("recomputed_observation_error_px", "mean recomputed reprojection error over observations"),
    number(
        "share_stale_point_errors",
        "share of points whose stored error differs from the recomputed one by more than 1e-3 px and 0.1 %",
    ),
    number("noise_nu0", "degrees of freedom of the spread of noise between tracks; large = all tracks alike"),
    px("noise_s0_px", "typical noise of a track per axis"),
    number("removable_share", "share of the squared residuals that moving the 3D points alone would remove"),
    count("num_nonstationary_images", "images with a pose_offset_px above the threshold"),
    count("num_accepted", "images whose verdict is accepted"),
    count("num_rejected", "images whose verdict is rejected"),
    count("num_undetermined", "images whose verdict is undetermined"),
    *(
        count(f"num_{verdict}_{member.short}", f"images whose {member} is {verdict}")
        for member in _ORDER_OF_COUNTS
        for verdict in Verdict
    ),
    texts("witnesses", "witnesses outside of the images that were asked (docs/witnesses.md); null where none was"),
    Column("findings", list_of(_FINDING), "text", "inconsistencies of the model: code, how many items, one line each"),
    Column(
        "diagnoses",
        list_of(DIAGNOSIS),
        "text",
        "what is the matter and what to do first, most urgent first (RUN stands for the run folder)",
    ),
)

OBSERVATIONS: Final[tuple[Column, ...]] = (
    *(Column(column.name, CODED_TEXT, column.unit, column.meaning) for column in _IDENTITY),
    stored_id("image_id", "id as stored"),
    Column("image_name", CODED_TEXT, "text", "name as stored"),
    Column("point2d_idx", INT64, "id", "position among the image's 2D points as stored, from 0"),
    Column("point3d_id", UINT64, "id", "id of its 3D point as stored"),
    px("x_px", "observed; the centre of the first pixel is 0.5"),
    px("y_px", "observed; the centre of the first pixel is 0.5"),
    px("residual_x_px", "observed - projected"),
    px("residual_y_px", "observed - projected"),
    count("track_length", "audited observations of its 3D point"),
    number("z_x", "standardised residual under noise_model of the image; null where its track cannot verify it"),
    number("z_y", "standardised residual under noise_model of the image; null where its track cannot verify it"),
)

TABLES: Final[dict[TableName, tuple[Column, ...]]] = {
    "images": IMAGES,
    "cameras": CAMERAS,
    "models": MODELS,
    "observations": OBSERVATIONS,
    "calibration": CALIBRATION,
    "calibration_residuals": CALIBRATION_RESIDUALS,
}


def schema(table: TableName, groups: Collection[ColumnGroup] = ()) -> pa.Schema:
    """Return the Arrow schema of a table; each field's metadata holds its unit and meaning.

    groups: of the images table, which columns it has besides those that are always there.
    """
    return _schema(table, frozenset(groups))


@cache
def _schema(table: TableName, groups: frozenset[ColumnGroup]) -> pa.Schema:
    columns = [
        *TABLES[table],
        *(column for group in GROUP_COLUMNS if group in groups for column in GROUP_COLUMNS[group]),
    ]
    import pyarrow as pa  # noqa: PLC0415 - nothing needs it before a table is made

    return pa.schema([pa.field(column.name, column.type, metadata=column.metadata) for column in columns])


def build_table(columns: Mapping[str, Given], wanted: pa.Schema) -> pa.Table:
    """Build an Arrow table of a given schema, see `audit.table.arrow.build_table`."""
    from sfm_audit.audit.table import arrow  # noqa: PLC0415 - nothing needs it before a table is made

    return arrow.build_table(columns, wanted)


def empty_table(table: TableName, groups: Collection[ColumnGroup] = ()) -> pa.Table:
    """Return a table without rows."""
    wanted = schema(table, groups)
    return build_table({name: [] for name in wanted.names}, wanted)
