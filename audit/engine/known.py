"""What is known of some images of a model before anything is decided, as columns.

`audit.engine.jointly` says the same of one image; a test holds the two together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import Any, Final, Protocol

import numpy as np

from sfm_audit.audit.camera_quality.measure import CameraQuality
from sfm_audit.audit.consistency import ModelConsistency
from sfm_audit.audit.decision.diagnostics import OwnDiagnostics, SharedMisfit
from sfm_audit.audit.decision.measured import (
    STATUS_CODES,
    Measured,
    MeasuredCamera,
    MeasuredMisfit,
    MeasuredNoise,
    MeasuredOwn,
    MeasuredParts,
)
from sfm_audit.audit.engine.image import unusable_reason
from sfm_audit.audit.engine.jointly import consistency_diagnostics
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.inliers.sanity import is_sane, is_usable
from sfm_audit.audit.joint import CameraStep, JointAudit
from sfm_audit.audit.misfit import fitted_param_idxs
from sfm_audit.audit.table.words import GROUPS, MisfitStatus, Reason
from sfm_audit.audit.witnesses.asking import Outside
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.camera_models import BY_ID
from sfm_audit.loaders.model import SparseModel

_in_order: Final = itemgetter(*GROUPS)
_numbers_of: Final = attrgetter(
    *("shape.plausibility.focal_over_size", "coverage", "identifiability.sd_focal_rel", "identifiability.sd_k1"),
    *("identifiability.parameters.singular_share", "identifiability.k1"),
)
_flags_of: Final = attrgetter(
    *("shape.plausibility.folds_over", "identifiability.has_focal", "identifiability.parameters.is_singular"),
    "identifiability.has_k1",
)


class ModelFacts(Protocol):
    """What the images of one model share, see `audit.engine.model.ModelAuditor`."""

    @property
    def model(self) -> SparseModel: ...  # noqa: D102
    @property
    def residuals(self) -> ModelResiduals: ...  # noqa: D102
    @property
    def quality(self) -> tuple[CameraQuality | None, ...]: ...  # noqa: D102
    @property
    def consistency(self) -> ModelConsistency: ...  # noqa: D102
    @property
    def joint(self) -> JointAudit | None: ...  # noqa: D102
    @property
    def steps(self) -> dict[int, CameraStep]: ...  # noqa: D102
    @property
    def own(self) -> Mapping[int, OwnDiagnostics]: ...  # noqa: D102
    @property
    def implied(self) -> Mapping[int, Mapping[str, float]]: ...  # noqa: D102
    @property
    def outside(self) -> Outside: ...  # noqa: D102
    @property
    def sigma_constant_px(self) -> FloatArray: ...  # noqa: D102

    def shared_misfit(self, image_idx: int) -> SharedMisfit | None: ...  # noqa: D102


def measured_of(facts: ModelFacts, image_idxs: range, noise: MeasuredNoise, largest_px: FloatArray) -> Measured:
    """Return what decides about some images of a model; noise and length of the longest residual (n,) of each."""
    model, images = facts.model, np.asarray(image_idxs, dtype=np.int64)
    qualities = facts.quality[image_idxs.start : image_idxs.stop]
    known = np.array([each is not None for each in qualities], dtype=bool)
    steps = _steps(facts, images, known)
    size_px = sizes_px(model, images)
    outside, consistency = facts.outside, facts.consistency
    half_pixel = np.zeros(len(images), dtype=bool)
    if consistency.half_pixel:
        half_pixel[:] = [bool(consistency.images[i].half_pixel) for i in image_idxs]
    asked = bool(outside.witnesses)
    gains = np.full((len(images), 3), math.nan)
    for row, step in enumerate(steps):
        if step is not None and facts.joint is not None:
            own = facts.joint.gains[image_idxs[row]]
            gains[row] = own.pose, own.camera, own.both
    return Measured(
        num_inliers=np.diff(facts.residuals.offsets)[images],
        noise=noise,
        pose_offset_px=facts.residuals.pose_offset_px[images],
        misfit=_misfit(facts, image_idxs, known),
        camera=_camera(qualities, known, size_px, steps),
        largest_residual_px=largest_px,
        longer_side_px=size_px.max(axis=1),
        unusable=_unusable(model, image_idxs, known),
        remarks={},
        parts=_parts(consistency, image_idxs),
        own=_own(facts, images, known, steps),
        gains=gains,
        half_pixel=half_pixel,
        testimonies=[outside.testimonies(i) for i in image_idxs] if asked else [None] * len(images),
    )


def sizes_px(model: SparseModel, images: IntArray) -> IntArray:
    """Return width and height (n, 2) of images, 0 without a camera."""
    camera_idx = model.images.camera_idx[images]
    if not len(model.cameras):
        return np.zeros((len(images), 2), dtype=np.int64)
    size = np.stack([model.cameras.width, model.cameras.height], axis=1).astype(np.int64)[camera_idx]
    return np.where(camera_idx[:, None] >= 0, size, 0)


def _steps(facts: ModelFacts, images: IntArray, known: BoolArray) -> list[CameraStep | None]:
    """The joint step of the camera of each image that takes part in the joint system."""
    joint, steps = facts.joint, facts.steps
    if joint is None:
        return [None] * len(images)
    part = (known & (joint.num_observations[images] > 0)).tolist()
    cameras = facts.model.images.camera_idx[images].tolist()
    return [steps.get(camera) if takes else None for camera, takes in zip(cameras, part, strict=True)]


def _unusable(model: SparseModel, image_idxs: range, known: BoolArray) -> dict[int, Reason]:
    """By row what makes it impossible to project any point; nothing does where the camera has been measured."""
    images = slice(image_idxs.start, image_idxs.stop)
    camera_idx = model.images.camera_idx[images]
    usable = dict.fromkeys(camera_idx[known].tolist(), True)
    for c in set(camera_idx[~known].tolist()) - set(usable):
        usable[c] = c >= 0 and is_usable(model.camera(c))
    sane = is_sane(model.images.quat_cam_from_world_wxyz[images]).all(axis=1)
    sane &= is_sane(model.images.translation_cam_from_world[images]).all(axis=1)
    sane &= np.array([usable[c] for c in camera_idx.tolist()], dtype=bool)
    reasons = {row: unusable_reason(model.image(image_idxs[row])) for row in np.flatnonzero(~sane).tolist()}
    return {row: reason for row, reason in reasons.items() if reason is not None}


def _parts(consistency: ModelConsistency, image_idxs: range) -> MeasuredParts:
    """Whether the parts of each image belong together."""
    images = consistency.images[image_idxs.start : image_idxs.stop]
    behind = consistency.points_behind
    found = [
        row
        for row, each in enumerate(images)
        if behind or each.explanation is not None or (each.inconsistent is None and each.share_in_front == 0.0)
    ]
    told = {row: consistency_diagnostics(images[row], all_behind=behind) for row in found}
    all_behind = np.zeros(len(images), dtype=bool)
    all_behind[[row for row, each in told.items() if each.all_behind]] = True
    return MeasuredParts(
        np.ones(len(images), dtype=bool),
        np.array([bool(each.inconsistent) for each in images], dtype=bool),
        all_behind,
        np.array([each.rms_px for each in images], dtype=np.float64),
        {row: each.text for row, each in told.items() if each.text},
    )


def _own(facts: ModelFacts, images: IntArray, known: BoolArray, steps: Sequence[CameraStep | None]) -> MeasuredOwn:
    """The own parameters of each image's camera; images of one camera have one record."""
    records = [None if step is None else facts.own[step.camera_idx] for step in steps]
    model, rows = facts.model, images[known]
    model_id = model.cameras.model_id[model.images.camera_idx[rows]]
    free = [each for each in set(model_id.tolist()) if fitted_param_idxs(BY_ID[each])]
    has_own = known.copy()
    has_own[known] = np.isin(model_id, free)
    return MeasuredOwn.of(records, has_own.tolist())


def _camera(
    qualities: Sequence[CameraQuality | None], known: BoolArray, size_px: IntArray, steps: Sequence[CameraStep | None]
) -> MeasuredCamera:
    """The numbers of each image's camera; deviations of the joint system where it takes part in it."""
    rows = np.flatnonzero(known)
    own = [each for each in qualities if each is not None]
    numbers, flags = np.full((len(known), 6), math.nan), np.zeros((len(known), 4), dtype=bool)
    cells: IntArray = np.zeros(len(known), dtype=np.int64)
    centre = np.full((len(known), 2), math.nan)
    if own:
        numbers[rows], flags[rows] = [_numbers_of(each) for each in own], [_flags_of(each) for each in own]
        cells[rows] = [each.occupied_cells for each in own]
        centre[rows] = [each.shape.plausibility.principal_point_px or (math.nan, math.nan) for each in own]
    focal_over_size, coverage, sd_focal_rel, sd_k1, share, k1 = numbers.T.copy()
    folds_over, has_focal, is_singular, has_k1 = flags.T.copy()
    joint = np.array([each is not None for each in steps], dtype=bool)
    for row in np.flatnonzero(joint).tolist():
        step, quality = steps[row], qualities[row]
        if step is not None and quality is not None:
            sd_focal_rel[row], sd_k1[row] = step.sd_focal_rel, _sd_k1(quality, step)
            is_singular[row] |= has_focal[row] and not step.focal_identified
    return MeasuredCamera(
        known=known,
        focal_over_size=focal_over_size,
        folds_over=folds_over,
        principal_point_px=centre,
        size_px=np.where(known[:, None], size_px, 0),
        coverage=coverage,
        occupied_cells=cells,
        has_focal=has_focal,
        sd_focal_rel=sd_focal_rel,
        singular_share=share,
        is_singular=is_singular,
        k1=np.where(has_k1, k1, math.nan),
        has_k1=has_k1,
        sd_k1=sd_k1,
        is_joint=joint,
    )


def _sd_k1(quality: CameraQuality, step: CameraStep) -> float:
    model = quality.shape.camera.model
    k1 = model.param_names[model.extra_idxs[0]] if model.extra_idxs else ""
    return float(step.sd[step.names.index(k1)]) if k1 in step.names else math.nan


def _misfit(facts: ModelFacts, image_idxs: range, known: BoolArray) -> MeasuredMisfit:
    """The tests on which the verdict about each image rests."""
    images, joint = np.asarray(image_idxs, dtype=np.int64), facts.joint
    asked = known & ~facts.consistency.inconsistent[images]
    num: IntArray = np.where(known, np.diff(facts.residuals.offsets)[images], 0)
    shape = len(images), len(GROUPS)
    numbers, rank, worth = np.full((*shape, 3), math.nan), np.full(shape, -1), np.full((*shape, 3), math.nan)
    numbers[:, :, 2] = -math.inf
    status = np.full(shape, STATUS_CODES[MisfitStatus.EXCLUDED])
    shared: dict[int, SharedMisfit] = {}
    rows = np.flatnonzero(asked)
    if joint is not None and rows.size:
        num[rows] = joint.num_observations[images[rows]]
        tests = [test for row in rows.tolist() for test in _in_order(joint.misfit.tests[image_idxs[row]])]
        fields = _fields(tests, np.repeat(num[rows], len(GROUPS)))
        numbers[rows], rank[rows], status[rows], worth[rows] = (
            each.reshape(rows.size, len(GROUPS), *each.shape[1:]) for each in fields
        )
        if joint.misfit.most_are_wrong:
            told = {row: facts.shared_misfit(image_idxs[row]) for row in rows.tolist()}
            shared = {row: each for row, each in told.items() if each is not None}
    status[~known] = STATUS_CODES[MisfitStatus.NO_COLUMNS]
    sigma_px = np.where(known, facts.sigma_constant_px[images], math.nan)
    q, px, gain = (np.ascontiguousarray(numbers[:, :, k]) for k in range(3))
    return MeasuredMisfit(known, num, sigma_px, q, px, gain, rank, status, worth, shared)


def _fields(tests: Sequence[Any], num: IntArray) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Of m joint tests: q, px, BIC gain (m, 3); rank, status (m,); worth (m, 3)."""
    numbers = np.array([(test.q, test.px, test.bic(n)) for test, n in zip(tests, num.tolist(), strict=True)])
    rank = np.array([-1 if test.rank is None else test.rank for test in tests], dtype=np.int64)
    status = np.array([STATUS_CODES[test.status] for test in tests], dtype=np.int64)
    worth = [(w.rotation_deg, w.centre_rel, w.focal_rel) for test in tests for w in (test.worth,)]
    return numbers, rank, status, np.array(worth, dtype=np.float64)
