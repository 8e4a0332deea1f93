"""From what is known and decided of some images to their part of the images table, column by column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import attrgetter, itemgetter
from typing import Any, Final

import numpy as np

from sfm_audit.audit.camera_quality.identifiability import ParameterCovariance, fitted_names
from sfm_audit.audit.camera_quality.measure import CameraQuality, expected_errors_px
from sfm_audit.audit.decision.columns import decision_columns
from sfm_audit.audit.decision.decisions import Decisions
from sfm_audit.audit.decision.diagnostics import OwnDiagnostics
from sfm_audit.audit.decision.measured import STATUSES, Measured, MeasuredMisfit
from sfm_audit.audit.engine.error_summary import ErrorSummary
from sfm_audit.audit.engine.jointly import pose_columns
from sfm_audit.audit.engine.known import ModelFacts, sizes_px
from sfm_audit.audit.engine.noise_columns import NoiseColumns
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.columns import IMPLIED, OUTSIDE_COLUMNS, own_parameter_names
from sfm_audit.audit.table.given import Coded, Column, Listed, Structs
from sfm_audit.audit.table.pose_columns import POSE_COLUMNS
from sfm_audit.audit.table.words import GROUPS
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import SparseModel

OWN_COLUMNS: Final = (
    "own_step_px",
    *(f"own_{name}_{what}" for name in own_parameter_names() for what in ("step", "sd")),
)
_OWN_PLACES: Final = {name: place for place, name in enumerate(OWN_COLUMNS)}
_OF_QUALITY: Final = {
    "median_depth": "median_depth",
    "sd_focal_px_conditional": "identifiability.sd_focal_px",
    "sd_focal_rel_conditional": "identifiability.sd_focal_rel",
    "sd_k1_conditional": "identifiability.sd_k1",
    "expected_error_px_conditional": "expected_error_px",
}
_quality_numbers: Final = attrgetter(*_OF_QUALITY.values())
_in_order: Final = itemgetter(*GROUPS)
_TESTIMONY: Final = ("witness", "score", "limit", "q", "unit", "text")


@dataclass(frozen=True, slots=True, eq=False)
class KnownImages:
    """What is known and decided of some images of a model.

    facts: that they share.    image_idxs: their rows.    errors: of their residuals.    advice: by image.
    """

    facts: ModelFacts
    image_idxs: range
    errors: ErrorSummary
    tested: NoiseColumns
    measured: Measured
    decisions: Decisions
    advice: Sequence[str | None]

    def __len__(self) -> int:
        return len(self.image_idxs)

    @property
    def images(self) -> IntArray:
        """(n,) their rows."""
        return np.asarray(self.image_idxs, dtype=np.int64)

    @property
    def qualities(self) -> tuple[CameraQuality | None, ...]:
        """What each says of its camera."""
        return self.facts.quality[self.image_idxs.start : self.image_idxs.stop]


def image_columns(
    known: KnownImages, labels: ModelLabels, noise_name: str, track_length: Int32Array
) -> dict[str, Column]:
    """Return the columns of some images; ``ks_q`` needs all images of the model and is left null.

    track_length : (n,) audited observations of the track of each inlier of the images
    """
    same = np.zeros(len(known), dtype=np.int64)
    measured, tested, images = known.measured, known.tested, known.images
    return {
        **{name: Coded(same, (text,)) for name, text in asdict(labels).items()},
        **_stored_columns(known.facts.model, images),
        **_counts(known, track_length),
        **known.errors.columns,
        "noise_model": Coded(same, (noise_name,)),
        **tested.columns,
        "ks_q": np.full(len(known), math.nan),
        **_misfit_columns(known.qualities),
        "advised_camera_model": known.advice,
        **_joint_misfit_columns(measured.misfit),
        "pose_offset_px": measured.pose_offset_px,
        **_camera_columns(known),
        **_own_columns(measured.own.records),
        **_implied_columns(known),
        "half_pixel": measured.half_pixel,
        **_pose_columns(known),
        **_outside_columns(known),
        **decision_columns(known.decisions, tested.sigma_constant_px),
    }


def _stored_columns(model: SparseModel, images: IntArray) -> dict[str, Column]:
    """What the model's files say of the images and their cameras."""
    table, cameras = model.images, model.cameras
    camera_idx = table.camera_idx[images]
    missing = camera_idx < 0
    size = sizes_px(model, images)
    names = [*(BY_ID[int(i)].name for i in cameras.model_id), None]  # row -1 is no camera
    counts = np.where(missing, 0, np.append(np.diff(cameras.param_offsets), 0)[camera_idx])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    starts = np.append(cameras.param_offsets[:-1], 0)[camera_idx]
    where = np.repeat(starts - offsets[:-1], counts) + np.arange(offsets[-1])
    codes = np.where(missing, len(cameras), camera_idx)
    return {
        "image_id": table.image_id[images],
        "image_name": [table.name[i] for i in images.tolist()],
        "camera_id": table.camera_id[images],
        "camera_model": Coded(codes, names),
        "width": np.ma.masked_array(size[:, 0], missing),
        "height": np.ma.masked_array(size[:, 1], missing),
        "params": Listed(offsets, cameras.params[where], ~missing),
        **dict(zip(("qw", "qx", "qy", "qz"), table.quat_cam_from_world_wxyz[images].T, strict=True)),
        **dict(zip(("tx", "ty", "tz"), table.translation_cam_from_world[images].T, strict=True)),
        "num_points2d": table.num_points2d[images],
    }


def _counts(known: KnownImages, track_length: Int32Array) -> dict[str, Column]:
    """How many observations there are of each kind, and how long their tracks are."""
    residuals, images, num = known.facts.residuals, known.images, known.measured.num_inliers
    lost = residuals.num_behind[images] + residuals.num_nonfinite[images] + residuals.num_dangling[images]
    total = np.concatenate([[0], np.cumsum(track_length, dtype=np.int64)])
    ends = residuals.offsets[known.image_idxs.start : known.image_idxs.stop + 1]
    ends = ends - ends[0]
    with np.errstate(invalid="ignore"):
        mean_length = np.diff(total[ends]) / num
    return {
        "num_linked": num + lost,
        "num_inliers": num,
        "num_behind": residuals.num_behind[images],
        "num_nonfinite": residuals.num_nonfinite[images],
        "num_dangling": residuals.num_dangling[images],
        "num_unverifiable": num - known.tested.num_standardised,
        "mean_track_length": mean_length,
    }


def _misfit_columns(qualities: Sequence[CameraQuality | None]) -> dict[str, Column]:
    """p, px and rank of every group, on the model as it stands."""
    rows = [row for row, each in enumerate(qualities) if each is not None]
    numbers = np.full((len(qualities), len(GROUPS), 3), math.nan)
    if rows:
        numbers[rows] = np.array(
            [
                (test.p, test.px, math.nan if test.rank is None else test.rank)
                for each in qualities
                if each is not None
                for test in _in_order(each.misfit)
            ]
        ).reshape(len(rows), len(GROUPS), 3)
    out: dict[str, Column] = {}
    for k, group in enumerate(GROUPS):
        out[f"misfit_{group}_p"], out[f"misfit_{group}_px"] = numbers[:, k, 0], numbers[:, k, 1]
        out[f"misfit_{group}_rank"] = _counted(numbers[:, k, 2])
    return out


def _counted(numbers: FloatArray) -> np.ma.MaskedArray[Any, np.dtype[np.int64]]:
    """Return counts; NaN is not known."""
    unknown = np.isnan(numbers)
    return np.ma.masked_array(np.where(unknown, 0.0, numbers).astype(np.int64), unknown)


def _joint_misfit_columns(misfit: MeasuredMisfit) -> dict[str, Column]:
    """Effect, q and rank of every group in the joint test, and what else is kept of it."""
    out: dict[str, Column] = {}
    for k, group in enumerate(GROUPS):
        out[f"misfit_{group}_px_joint"], out[f"misfit_{group}_q_joint"] = misfit.px[:, k], misfit.q[:, k]
        out[f"misfit_{group}_rank_joint"] = np.ma.masked_less(misfit.rank[:, k], 0)
    num_known = np.count_nonzero(misfit.known)
    worth = misfit.worth[misfit.known].reshape(-1, 3)
    details: dict[str, Column] = {
        "group": Coded(np.tile(np.arange(len(GROUPS)), num_known), GROUPS),
        "status": Coded(misfit.status[misfit.known].ravel(), STATUSES),
        "gain": misfit.gain[misfit.known].ravel(),
        **dict(zip(("worth_deg", "worth_centre", "worth_focal_rel"), worth.T, strict=True)),
    }
    offsets = np.concatenate([[0], len(GROUPS) * np.cumsum(misfit.known)])
    return {
        **out,
        "num_misfit_tested": np.ma.masked_array(misfit.num_tested, ~misfit.known),
        "misfit_details": Listed(offsets, Structs(details), misfit.known),
    }


def _camera_columns(known: KnownImages) -> dict[str, Column]:
    """What each image says of its camera."""
    camera, qualities = known.measured.camera, known.qualities
    rows = np.flatnonzero(camera.known)
    numbers = np.full((len(known), len(_OF_QUALITY)), math.nan)
    if rows.size:
        numbers[rows] = [_quality_numbers(each) for each in qualities if each is not None]
    columns = dict(zip(_OF_QUALITY, numbers.T, strict=True))
    sd_focal_px, error_px = columns["sd_focal_px_conditional"].copy(), columns["expected_error_px_conditional"].copy()
    has_camera = known.facts.model.images.camera_idx[known.images] >= 0
    error_px = np.where(camera.is_joint, _joint_errors_px(known), error_px)
    for row in np.flatnonzero(camera.is_joint & camera.has_focal).tolist():
        sd_focal_px[row] = _sd_of_first_focal(known.measured.own.records[row], qualities[row])
    return {
        **columns,
        "coverage": np.where(camera.known, camera.coverage, np.where(has_camera, 0.0, math.nan)),
        "occupied_cells": np.ma.masked_array(camera.occupied_cells, ~camera.known & ~has_camera),
        "sd_focal_px": sd_focal_px,
        "sd_focal_rel": camera.sd_focal_rel,
        "sd_k1": camera.sd_k1,
        "sd_focal_rel_joint": np.where(camera.is_joint, camera.sd_focal_rel, math.nan),
        "focal_over_size": camera.focal_over_size,
        "folds_over": np.ma.masked_array(camera.folds_over, ~camera.known),
        "singular_share": camera.singular_share,
        "expected_error_px": error_px,
    }


def _joint_errors_px(known: KnownImages) -> FloatArray:
    """(n,) expected errors of a measurement from the joint covariances of poses and own parameters; else NaN."""
    errors_px, joint = np.full(len(known), math.nan), known.facts.joint
    asked = [
        (row, quality, joint.covariances[known.image_idxs[row]])
        for row, quality in enumerate(known.qualities)
        if joint is not None and quality is not None and known.measured.camera.is_joint[row]
    ]
    asked = [each for each in asked if each[2].size and math.isfinite(each[2].sum())]
    if asked:
        rows, qualities, covariances = zip(*asked, strict=True)
        shapes = [quality.shape for quality in qualities]
        named = zip(shapes, covariances, strict=True)
        parameters = [ParameterCovariance(fitted_names(shape.camera.model), own, 1.0) for shape, own in named]
        sigma_px = known.facts.sigma_constant_px[known.images[list(rows)]]
        depth = np.array([quality.median_depth for quality in qualities])
        errors_px[list(rows)] = expected_errors_px(shapes, parameters, sigma_px, depth)
    return errors_px


def _sd_of_first_focal(own: OwnDiagnostics | None, quality: CameraQuality | None) -> float:
    if own is None or quality is None:
        return math.nan
    model = quality.shape.camera.model
    first = model.param_names[model.focal_idxs[0]]
    return next((step.sd for step in own.steps if step.name == first), math.nan)


def own_numbers(own: OwnDiagnostics | None) -> FloatArray:
    """Return the joint step of every parameter that some camera model has, in the order of ``OWN_COLUMNS``."""
    numbers = np.full(len(OWN_COLUMNS), math.nan)
    if own is not None:
        numbers[0] = own.step_px
        for step in own.steps:
            numbers[_OWN_PLACES[f"own_{step.name}_step"]] = step.step
            numbers[_OWN_PLACES[f"own_{step.name}_sd"]] = step.sd
    return numbers


def _own_columns(records: Sequence[OwnDiagnostics | None]) -> dict[str, Column]:
    """Steps of each image's camera; a camera that images share is looked at once."""
    places = {id(each): place for place, each in enumerate({id(each): each for each in records}.values())}
    distinct = list({id(each): each for each in records}.values())
    at = [places[id(each)] for each in records]
    steps = np.array([own_numbers(each) for each in distinct]).reshape(-1, len(OWN_COLUMNS))[at].T
    rest = (
        np.array(
            [
                (math.nan, math.nan, math.nan)
                if each is None
                else (each.num_images, each.sigma_px, each.largest.implied if each.largest else math.nan)
                for each in distinct
            ]
        )
        .reshape(-1, 3)[at]
        .T
    )
    return {
        **dict(zip(OWN_COLUMNS, steps, strict=True)),
        "own_num_images": _counted(rest[0]),
        "own_sigma_px": rest[1],
        "own_implied": rest[2],
    }


def _implied_columns(known: KnownImages) -> dict[str, Column]:
    """Gains, and changes that parameters which nobody freed would take."""
    gains = dict(zip(("gain_pose", "gain_camera", "gain_both"), known.measured.gains.T, strict=True))
    implied = known.facts.implied
    cameras = known.facts.model.images.camera_idx[known.images].tolist()
    takes_part = known.measured.camera.is_joint.tolist()
    nothing: Mapping[str, float] = {}
    own = [implied.get(c, nothing) if takes else nothing for c, takes in zip(cameras, takes_part, strict=True)]
    return {
        **gains,
        **{name: np.array([each.get(name, math.nan) for each in own], dtype=np.float64) for name in IMPLIED},
    }


def _pose_columns(known: KnownImages) -> dict[str, Column]:
    """How well each pose is known, where somebody asked."""
    joint, num = known.facts.joint, len(known)
    if joint is None or not joint.poses:
        return {name: [None] * num if null is None else np.full(num, null) for name, null in POSE_COLUMNS.items()}
    names, takes_part = known.facts.model.images.name, known.measured.camera.is_joint.tolist()
    found = [
        pose_columns(joint, image_idx, names) if takes else {}
        for image_idx, takes in zip(known.image_idxs, takes_part, strict=True)
    ]
    return {name: [each.get(name, null) for each in found] for name, null in POSE_COLUMNS.items()}


def _outside_columns(known: KnownImages) -> dict[str, Column]:
    """What witnesses outside of the images measured, and what they said of each."""
    num, rows = len(known), slice(known.image_idxs.start, known.image_idxs.stop)
    measured: dict[str, Column] = {
        name: [None] * num if null is None else np.full(num, null) for name, null in OUTSIDE_COLUMNS.items()
    }
    for report in known.facts.outside.reports:
        measured |= {name: values[rows] for name, values in report.columns.items()}
    testimonies = known.measured.testimonies
    asked: BoolArray = np.array([each is not None for each in testimonies], dtype=bool)
    offsets = np.concatenate([[0], np.cumsum([0 if each is None else len(each) for each in testimonies])])
    said = [each for own in testimonies for each in own or ()]
    fields: dict[str, Column] = {name: [getattr(each, name) for each in said] for name in _TESTIMONY}
    return {
        **measured,
        "witnesses": Listed(offsets, fields["witness"], asked),
        "testimonies": Listed(offsets, Structs(fields), asked),
    }
