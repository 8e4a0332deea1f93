"""What would a parameter be that nobody freed? Each candidate joins the base alone (method.md section 11)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, partial
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.cameras.functions import Term
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.inliers.projected import ProjectedImage
from sfm_audit.audit.joint.candidates import CandidateScores, FieldsInParts, ImageFields, candidate_scores
from sfm_audit.audit.joint.common_scores import common_scores
from sfm_audit.audit.joint.layout import median_of
from sfm_audit.audit.joint.own import CameraStep
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, candidate_fields, follows_the_lens
from sfm_audit.audit.table.words import MisfitGroup
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

MAX_SD_FOCAL_REL: Final = 0.003
MIN_SDS: Final = 5.0
MIN_SHIFT_OVER_WIDTH: Final = 0.004
MIN_GAIN_PX: Final = 0.1
_ABSORBED: Final = 1e-10  # of K with unit columns; 8 px of a common principal point leave 1e-5 of their square
_RADIAL: Final = (Term.RADIAL_2, Term.RADIAL_4, Term.RADIAL_6)


class Implied(StrEnum):
    """Parameters that the camera model lacks or that nobody refines."""

    PRINCIPAL_POINT = "principal_point"
    RADIAL = "radial"
    ASPECT = "aspect"
    TANGENTIAL = "tangential"


_COLUMNS: Final = {
    Implied.PRINCIPAL_POINT: slice(0, 2),
    Implied.RADIAL: slice(2, 3),
    Implied.ASPECT: slice(3, 4),
    Implied.TANGENTIAL: slice(4, 6),
}


@dataclass(frozen=True, slots=True, eq=False)
class ImpliedParameter:
    """A parameter's implied change, had it alone been free beside the base.

    image_idxs: the images that it was one parameter of.    camera_idx: None for all cameras of one image size.
    names, unit, step, sd: (k,) of the change; sd is a sandwich clustered by track.
    sd_focal_rel: of the camera (the median over the cameras) in the base system.
    px: what freeing it would gain, RMS px.    found: whether the rule of section 11 makes a finding of it.
    """

    parameter: Implied
    camera_idx: int | None
    image_idxs: IntArray
    names: tuple[str, ...]
    unit: str
    step: FloatArray
    sd: FloatArray
    sd_focal_rel: float
    px: float
    found: bool


class ImpliedBeside:
    """Asks for the missing parameters of cameras with a single image along with the misfit test of that image.

    One projection off the base then serves both: see `sfm_audit.audit.joint.misfit.Beside`.
    """

    def __init__(self, system: JointSystem, steps: tuple[CameraStep, ...]) -> None:
        self._system = system
        self._asked = {
            int(step.image_idxs[0]): _asked_of(system, step)
            for step in steps
            if len(step.image_idxs) == 1 and _can_lack(system, step)
        }
        self._taken: list[tuple[_Asked, CandidateScores]] = []

    def fields(
        self, image_idx: int, camera: CameraRecord, projected: ProjectedImage, candidates: FloatArray
    ) -> FloatArray:
        """(6, 2, n) the columns of the image's camera; none of cameras with several images."""
        if image_idx not in self._asked:
            return candidates[:0]
        return _missing_columns(camera, projected, candidates)

    def power(self, image_idx: int) -> int:
        """Of r^2 in the next radial term; 0 for images that are not asked here."""
        asked = self._asked.get(image_idx)
        return 0 if asked is None else next_power(asked.camera)

    def take(self, image_idx: int, scores: CandidateScores) -> None:
        """Note what the columns would be."""
        asked = self._asked.get(image_idx)
        if asked is not None:
            self._taken.append((asked, scores))

    def found(self) -> dict[int, list[ImpliedParameter]]:
        """Return what the parameters of each camera that was noted would be."""
        asked = [each for each, _ in self._taken]
        found = _implied(self._system, asked, [scores for _, scores in self._taken])
        by_camera = zip((each.camera_idx for each in asked), found, strict=True)
        return {camera: parameters for camera, parameters in by_camera if camera is not None}


def implied_parameters(
    system: JointSystem,
    steps: tuple[CameraStep, ...],
    found: Mapping[int, list[ImpliedParameter]] | None = None,
) -> list[ImpliedParameter]:
    """Return what every camera's missing parameters would be, then a principal point common to each image size.

    Parameters
    ----------
    steps : of `own_parameters`        found : by camera, what is known already (`ImpliedBeside`)
    """
    return [*implied_of_cameras(system, steps, {} if found is None else found), *implied_of_sizes(system, steps)]


def implied_of_cameras(
    system: JointSystem, steps: tuple[CameraStep, ...], found: Mapping[int, list[ImpliedParameter]]
) -> list[ImpliedParameter]:
    """Return what every camera's missing parameters would be; ``found``: by camera, what is known already."""
    out: list[ImpliedParameter] = []
    for camera in steps:
        if camera.camera_idx in found:
            out += found[camera.camera_idx]
        elif _can_lack(system, camera):
            out += _of_images(system, _asked_of(system, camera))
    return out


def implied_of_sizes(system: JointSystem, steps: tuple[CameraStep, ...]) -> list[ImpliedParameter]:
    """Return a principal point common to the cameras of each image size with several of them."""
    by_size: dict[tuple[int, int], list[CameraStep]] = {}
    for step in steps:
        if _can_lack(system, step):
            camera = system.model.camera(step.camera_idx)
            by_size.setdefault((camera.width, camera.height), []).append(step)
    out: list[ImpliedParameter] = []
    for cameras in by_size.values():
        if len(cameras) > 1:
            record = system.model.camera(cameras[0].camera_idx)
            images = np.sort(np.concatenate([camera.image_idxs for camera in cameras]))
            sd_focal_rel = float(np.median([camera.sd_focal_rel for camera in cameras]))
            out += _of_images(system, _Asked(images, record, None, sd_focal_rel))
    return out


class _Asked(NamedTuple):
    """Whose parameters: images, the camera (one of them), its row or None for all of one size, sd_f / f."""

    images: IntArray
    camera: CameraRecord
    camera_idx: int | None
    sd_focal_rel: float


def _can_lack(system: JointSystem, step: CameraStep) -> bool:
    return bool(step.num_observations) and not system.model.camera(step.camera_idx).model.is_spherical


def _asked_of(system: JointSystem, step: CameraStep) -> _Asked:
    camera = system.model.camera(step.camera_idx)
    images = step.image_idxs[np.diff(system.observations.offsets)[step.image_idxs] > 0]
    return _Asked(images, camera, step.camera_idx, step.sd_focal_rel)


def _missing_fields(system: JointSystem, image: int, chosen: slice | IntArray) -> ImageFields:
    """Six columns, px per unit: principal point (px), next radial term, aspect (relative), tangential p1, p2."""
    inliers = system.observations.inliers(image, chosen)
    camera, projected = inliers.camera, inliers.projected
    out = _missing_columns(camera, projected, candidate_fields(camera, projected))
    return ImageFields(np.ascontiguousarray(out.transpose(2, 1, 0)), system.observations.nuisance(image, chosen))


def _missing_columns(camera: CameraRecord, projected: ProjectedImage, candidates: FloatArray) -> FloatArray:
    """(6, 2, n), see `_missing_fields`; ``candidates`` of `candidate_fields`."""
    out = np.zeros((6, *candidates.shape[1:]))
    out[0, 0], out[1, 1] = 1.0, 1.0
    out[2] = _next_radial(camera, projected)
    out[3] = candidates[GROUP_COLUMNS[MisfitGroup.AFFINE]][0]
    out[4:] = candidates[GROUP_COLUMNS[MisfitGroup.TANGENTIAL]]
    return out


def _shift_fields(system: JointSystem, image: int, chosen: slice | IntArray) -> ImageFields:
    """The two columns of the principal point, px."""
    nuisance = system.observations.nuisance(image, chosen)
    return ImageFields(np.tile(np.eye(2), (len(nuisance), 1, 1)), nuisance)


def _next_radial(camera: CameraRecord, projected: ProjectedImage) -> FloatArray:
    """(2, n) field of the first radial term that the model lacks."""
    focals = camera.model.focal_idxs
    scale = np.array([[camera.params[focals[0]]], [camera.params[focals[-1]]]])
    return np.asarray(scale * projected.u * (projected.u**2).sum(axis=0) ** next_power(camera))


def next_power(camera: CameraRecord) -> int:
    """Return the power of r^2 in the first radial term that the model lacks."""
    terms = functions_of(camera.model).terms
    return next((k for k, term in enumerate(_RADIAL) if term not in terms), len(_RADIAL)) + 1


@cache
def _lacking(model: CameraModel) -> dict[Implied, tuple[tuple[str, ...], str]]:
    """Names and unit of what a camera model lacks or nobody refines."""
    terms = functions_of(model).terms
    missing = [k for k, term in enumerate(_RADIAL) if term not in terms]
    out: dict[Implied, tuple[tuple[str, ...], str]] = {Implied.PRINCIPAL_POINT: (("cx", "cy"), "px")}
    if missing:
        out[Implied.RADIAL] = (f"k{missing[0] + 1}",), "1"
    if Term.ASPECT not in terms:
        out[Implied.ASPECT] = ("fx / fy - 1",), "1"
    if Term.TANGENTIAL not in terms:
        out[Implied.TANGENTIAL] = ("p1", "p2"), "1"
    return out


def _of_images(system: JointSystem, asked: _Asked) -> list[ImpliedParameter]:
    images = asked.images[np.diff(system.observations.offsets)[asked.images] > 0]
    is_camera = asked.camera_idx is not None
    compiled = None
    if not is_camera or follows_the_lens(asked.camera.model):
        compiled = common_scores(system, images, asked.camera if is_camera else None, next_power(asked.camera))
    if compiled is not None:
        return _implied(system, [asked._replace(images=images)], [compiled])[0]
    columns = _missing_fields if is_camera else _shift_fields

    def fields_of(image: int) -> FieldsInParts:
        return FieldsInParts(partial(columns, system, image))

    scores = candidate_scores(system.base, images.tolist(), fields_of)
    return _implied(system, [asked._replace(images=images)], [scores])[0]


def _implied(
    system: JointSystem, asked: Sequence[_Asked], scores: Sequence[CandidateScores]
) -> list[list[ImpliedParameter]]:
    """What the parameters of each that was asked for would be, from the scores of all their columns."""
    of_all = np.array([median_of(system.observations.sigma_px, each.images) for each in asked])
    out: list[list[ImpliedParameter]] = [[] for _ in asked]
    for parameter, columns in _COLUMNS.items():
        is_shift = parameter is Implied.PRINCIPAL_POINT
        chosen = [
            k
            for k, each in enumerate(asked)
            if parameter in _lacking(each.camera.model) and (is_shift or each.camera_idx is not None)
        ]
        if not chosen:
            continue
        step, sd, gain = _alone([scores[k] for k in chosen], columns)
        sigma_px = of_all[chosen]
        with np.errstate(invalid="ignore", over="ignore"):
            px = sigma_px * np.sqrt(np.maximum(gain, 0.0) / [scores[k].num_observations for k in chosen])
            large = np.abs(step) > MIN_SDS * sd
            if is_shift:
                large &= np.abs(step) > MIN_SHIFT_OVER_WIDTH * np.array([[asked[k].camera.width] for k in chosen])
            known = np.array([asked[k].sd_focal_rel for k in chosen]) <= MAX_SD_FOCAL_REL
            found = known & large.any(axis=1) & (is_shift | (px > MIN_GAIN_PX))
        for number, k in enumerate(chosen):
            images, camera, camera_idx, sd_focal_rel = asked[k]
            names, unit = _lacking(camera.model)[parameter]
            value, told = (step[number], sd[number], sd_focal_rel), (float(px[number]), bool(found[number]))
            out[k].append(ImpliedParameter(parameter, camera_idx, images, names, unit, *value, *told))
    return out


def _alone(scores: Sequence[CandidateScores], own: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Steps K^+ u (b, k), their sd K^+ (sum G G^T) K^+, and gains (b,); NaN where the base absorbs a direction."""
    gram, meat = (np.stack([getattr(each, name)[own, own] for each in scores]) for name in ("gram", "meat"))
    score, sq_length = (np.stack([getattr(each, name)[own] for each in scores]) for name in ("score", "sq_length"))
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(sq_length)
        both = scale[:, :, None] * scale[:, None, :]
        gram = gram * both
        smallest, inverse = _smallest_eigenvalue(gram), _inverse(gram) * both
        step = (inverse * score[:, None, :]).sum(axis=2)
        moved = (inverse[:, :, :, None] * meat[:, None, :, :]).sum(axis=2)
        sd = np.sqrt(np.maximum((moved * inverse).sum(axis=2), 0.0))
        gain = (step * score).sum(axis=1)
    unknown = ~(np.isfinite(gram).all(axis=(1, 2)) & (smallest > _ABSORBED))
    step[unknown], sd[unknown], gain[unknown] = math.nan, math.nan, math.nan
    return step, sd, gain


def _smallest_eigenvalue(gram: FloatArray) -> FloatArray:
    """Of symmetric matrices (b, k, k), k = 1 or 2."""
    a, d = gram[:, 0, 0], gram[:, -1, -1]
    if gram.shape[1] == 1:
        return a
    return np.asarray(0.5 * (a + d) - np.hypot(0.5 * (a - d), gram[:, 0, 1]))


def _inverse(gram: FloatArray) -> FloatArray:
    """Of symmetric matrices (b, k, k), k = 1 or 2."""
    if gram.shape[1] == 1:
        return np.asarray(1.0 / gram)
    a, b, d = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    turned = np.stack([np.stack([d, -b], axis=1), np.stack([-b, a], axis=1)], axis=1)
    return np.asarray(turned / (a * d - b * b)[:, None, None])
