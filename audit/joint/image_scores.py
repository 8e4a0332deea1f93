"""`candidate_scores` of one image through the compiled sums.

All candidate fields of an image are made of fewer functions than there are fields: scalars along x and the same along y
(the principal point, the affine and the smooth fields), and some with both components. The sums are those of these 44;
the fields' follow by a small matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.cameras.projection import is_fisheye
from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.design import POINT
from sfm_audit.audit.joint.group_test import KEPT_EIGENVALUE, MIN_OBSERVATIONS_PER_RANK, SINGULAR_MEAT
from sfm_audit.audit.joint.sums import joint_sums
from sfm_audit.audit.joint.system import Base, JointSystem
from sfm_audit.audit.kernels.joint import FIELDS, SCALAR, JointSums
from sfm_audit.audit.kernels.joint_groups import Fields, GroupLimits, GroupNumbers, group_numbers
from sfm_audit.audit.kernels.joint_scores import Asked, IncludedArrays, JointScores, Scores, SeenArrays
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS, follows_the_lens
from sfm_audit.audit.table.words import MisfitGroup
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord, rotation_from_quat

_X, _Y, _BOTH = 0, SCALAR, 2 * SCALAR  # where functions along x, along y and with both components begin
_ROLLING, _NEXT = _BOTH + 4, _BOTH + 10
_LEFT_OF_TERMS: Final = 1e-4  # share of its functions' squared lengths that a field has at least: four digits may go
_MISSING: Final = 6
"""Columns of the parameters that a camera may lack, behind the candidate fields: see `implied`."""
SHIFT: Final = np.zeros((FIELDS, 2))
"""(44, 2) of which functions a shift of the image is made."""
SHIFT[_X, 0] = SHIFT[_Y, 1] = 1.0


def sums_of_base(base: Base) -> JointSums | None:
    """Return the compiled sums over a base; None where numpy is to be used."""
    included = {image: extra.fields for image, extra in base.included.items()}
    return joint_sums(base.observations, base.left_px, base.observations.weight, base.point_inverse, included)


class ScoresOfMany:
    """`candidate_scores` of an image each, many images in one call of a kernel.

    Of R and B they have the rows of the image's own columns alone: all that its tests ask for.
    """

    def __init__(self, system: JointSystem, base: Base, sums: JointSums) -> None:
        observations = system.observations
        self._system, self._sums = system, sums
        first = np.full(len(system.model.images), -1, dtype=np.int64)
        for image, extra in base.included.items():
            first[image] = int(extra.columns[0]) - len(base.inverse.main) if extra.columns.size else 0
        included = IncludedArrays(base.inverse.update, base.inverse.border, base.inverse.corner, first)
        given = observations.layout.columns, observations.transform, base.inverse.main.arrays()
        self._kernel = JointScores(sums, *given, included=included, seen=seen_by(system))

    def scores(self, images: Sequence[int], powers: Sequence[int]) -> list[CandidateScores | None]:
        """Return the scores of some images; None where the numpy path has to be taken.

        Parameters
        ----------
        powers : of r^2 in the radial term of the missing parameters, of each image, 0 without these
        """
        out: list[CandidateScores | None] = [None] * len(images)
        asked = self._asked(images, powers)
        for k, each in zip(asked.places, self._told(asked), strict=True) if asked else ():
            out[k] = each
        return out

    def tested(self, images: Sequence[int], powers: Sequence[int]) -> list[GroupSumsOfImage | CandidateScores | None]:
        """Return the same as what the tests of groups need of it, where that is certain."""
        out: list[GroupSumsOfImage | CandidateScores | None] = [None] * len(images)
        asked = self._asked(images, powers)
        if asked is None:
            return out
        numbers = _numbers_of(asked)
        counts = np.diff(self._system.observations.offsets)[asked.images]
        batch = GroupSumsOfImages(asked.images, asked.sums.num_tracks, counts, numbers) if numbers else None
        in_doubt = np.ones(len(asked.places), dtype=bool) if batch is None else ~batch.numbers.done
        for place, k in enumerate(asked.places):
            if batch is not None and not in_doubt[place]:
                out[k] = GroupSumsOfImage(batch, place)
        if in_doubt.any():
            some = asked.only(np.flatnonzero(in_doubt))
            for k, each in zip(some.places, self._told(some), strict=True):
                out[k] = each
        return out

    def _asked(self, images: Sequence[int], powers: Sequence[int]) -> _Summed | None:
        """What the kernel says of those images that it can be asked about; None where there are none."""
        of_all = [self._system.model.camera(int(self._system.observations.layout.camera_idx[i])) for i in images]
        asked = [k for k, i in enumerate(images) if follows_the_lens(of_all[k].model) and self._sums.can(i)]
        if not asked:
            return None
        chosen = np.array([images[k] for k in asked], dtype=np.int64)
        power = np.array([powers[k] for k in asked], dtype=np.int64)
        cameras = [of_all[k] for k in asked]
        found = self._kernel.of(asked_of(self._system, chosen, cameras, power))
        return None if found is None else _Summed(asked, chosen, power, _factors_of(cameras), found)

    def _told(self, asked: _Summed) -> list[CandidateScores | None]:
        images, power, found, made_of = asked.images, asked.power, asked.sums, _fields_of(asked.factor)
        turned = made_of.transpose(0, 2, 1)
        with np.errstate(over="ignore", invalid="ignore"):
            done = found.done & np.isfinite(found.gram).all(axis=(1, 2)) & np.isfinite(found.meat).all(axis=(1, 2))
            squares = _squares(found.plain, found.dense_plain)
            sq_length = ((squares @ made_of) * made_of).sum(axis=1)
            gone = sq_length < _LEFT_OF_TERMS * (np.einsum("bii->bi", squares)[:, :, None] * made_of**2).sum(axis=1)
            gram, meat = (turned @ each @ made_of for each in (found.gram, found.meat))
            score = (turned @ found.score[:, :, None])[:, :, 0]
        layout = self._system.observations.layout
        columns = layout.columns[images]
        order = np.argsort(columns, axis=1, kind="stable")[:, :, None]
        right, solution = (np.take_along_axis(each, order, axis=1) for each in (found.right, found.solution))
        out: list[CandidateScores | None] = []
        for k, image in enumerate(images.tolist()):
            fields = slice(0, NUM_FIELDS + _MISSING if power[k] else NUM_FIELDS)
            if not done[k] or np.isnan(sq_length[k]).any() or gone[k, fields].any():
                out.append(None)
                continue
            support = np.sort(columns[k][columns[k] < layout.num_columns])
            of_fields = sq_length[k, fields], gram[k, fields, fields], score[k, fields], meat[k, fields, fields]
            at = right[k, : support.size], support, solution[k, : support.size]
            num = self._system.observations.num_of(image)
            out.append(CandidateScores(*of_fields, int(found.num_tracks[k]), *at, num, made_of[k, :, fields]))
        return out


class _Summed(NamedTuple):
    """What the kernel says of some images.

    places: where among those that were asked for.    factor: see `_factors_of`.
    """

    places: list[int]
    images: IntArray
    power: IntArray
    factor: FloatArray
    sums: Scores

    def only(self, chosen: IntArray) -> _Summed:
        """Those of some of the images."""
        places = [self.places[k] for k in chosen.tolist()]
        return _Summed(places, self.images[chosen], self.power[chosen], self.factor[chosen], self.sums.only(chosen))


@dataclass(frozen=True, slots=True, eq=False)
class GroupSumsOfImages:
    """What the tests of all groups of some images (k,) need.    num_tracks, num_observations: (k,)."""

    images: IntArray
    num_tracks: IntArray
    num_observations: IntArray
    numbers: GroupNumbers


class GroupSumsOfImage(NamedTuple):
    """One of these images, by its place among them."""

    batch: GroupSumsOfImages
    place: int

    def missing(self) -> CandidateScores:
        """Return the scores of the missing parameters, without what they do to the base."""
        k, numbers, nowhere = self.place, self.batch.numbers, np.zeros((0, _MISSING))
        of_fields = numbers.rest_square[k], numbers.rest_gram[k], numbers.rest_score[k], numbers.rest_meat[k]
        counts = int(self.batch.num_tracks[k]), int(self.batch.num_observations[k])
        return CandidateScores(*of_fields, counts[0], nowhere, np.zeros(0, dtype=np.int64), nowhere, counts[1])


def _numbers_of(asked: _Summed) -> GroupNumbers | None:
    """All groups of some images by the kernel; None where there is none."""
    limits = GroupLimits(_LEFT_OF_TERMS, KEPT_EIGENVALUE, SINGULAR_MEAT, MIN_OBSERVATIONS_PER_RANK)
    return group_numbers(asked.sums, Fields(_TERMS, asked.factor, _ENDS, asked.power > 0), limits)


def scores_of_many(system: JointSystem, base: Base) -> ScoresOfMany | None:
    """Return who asks about many images at once; None where each has to be asked by numpy."""
    sums = sums_of_base(base)
    return ScoresOfMany(system, base, sums) if sums is not None and sums.repeats_follow else None


def seen_by(system: JointSystem) -> SeenArrays:
    """Return where the points of a system, and what was observed, are found."""
    observations, residuals, model = system.observations, system.residuals, system.model
    return SeenArrays(
        *(model.points.xyz_world, model.observations.xy_px, residuals.residuals_px, residuals.observation_row),
        *(observations.points, observations.source),
    )


def asked_of(system: JointSystem, images: IntArray, cameras: Sequence[CameraRecord], power: IntArray) -> Asked:
    """Return what the kernels ask about images: their facts, which are fisheyes, the power of the next radial term."""
    fisheye = np.array([is_fisheye(camera.model) for camera in cameras], dtype=np.int64)
    return Asked(images, _facts(system, images, cameras), fisheye, power)


def missing_of(camera: CameraRecord) -> FloatArray:
    """(44, 6) of which functions the columns of the missing parameters are made (`implied`)."""
    return np.asarray(_fields_of(_factors_of([camera]))[0, :, NUM_FIELDS:])


def _facts(system: JointSystem, images: IntArray, cameras: Sequence[CameraRecord]) -> FloatArray:
    """(k, 27) facts of `JointSums.fields`."""
    table = system.model.images
    rotation = rotation_from_quat(table.quat_cam_from_world_wxyz[images])
    fx, fy, _, _, width, height = _lenses(cameras).T
    if system.observations.layout.has_rigs:
        inverse = np.linalg.pinv(rotation)
    else:
        inverse = system.observations.transform[images][:, POINT, POINT]
    lens = np.stack([fx, fy, 0.5 * width, 0.5 * height, 0.5 * np.maximum(width, height), height], axis=1)
    pose = rotation.reshape(-1, 9), table.translation_cam_from_world[images]
    return np.concatenate([*pose, lens, inverse.reshape(-1, 9)], axis=1)


def _terms() -> IntArray:
    """(48, 2) functions of each field, the missing parameters' included; -1 where it has one only."""
    out = np.full((NUM_FIELDS + _MISSING, 2), -1)
    first = {group: own.start for group, own in GROUP_COLUMNS.items()}
    affine, tangential, smooth = first[MisfitGroup.AFFINE], first[MisfitGroup.TANGENTIAL], first[MisfitGroup.SMOOTH]
    for axis in range(2):
        out[first[MisfitGroup.RADIAL] + axis, 0] = _BOTH + axis
        out[tangential + axis, 0] = _BOTH + 2 + axis
        out[affine + axis] = _X, _X + 1 + axis  # fx v_x = x - cx
        out[first[MisfitGroup.PRINCIPAL_POINT] + axis, 0] = (_X, _Y)[axis]
        out[smooth + axis * _MONOMIALS : smooth + (axis + 1) * _MONOMIALS, 0] = (
            (_X, _Y)[axis] + 1 + np.arange(_MONOMIALS)
        )
    rolling = first[MisfitGroup.ROLLING_SHUTTER]
    out[rolling : rolling + 6, 0] = _ROLLING + np.arange(6)
    out[NUM_FIELDS:] = [(_X, -1), (_Y, -1), (_NEXT, -1), out[affine], *out[tangential : tangential + 2]]
    return out


_MONOMIALS: Final = SCALAR - 2
_TERMS: Final = _terms()
_ENDS: Final = np.array([0, *(own.stop for own in GROUP_COLUMNS.values())])


def _factors_of(cameras: Sequence[CameraRecord]) -> FloatArray:
    """(B, 48, 2) how much of each of these functions is in a field, of each camera."""
    fx, fy, cx, cy, width, height = _lenses(cameras).T
    half = 0.5 * np.maximum(width, height)
    out = np.ones((len(cameras), *_TERMS.shape))
    affine, shift = GROUP_COLUMNS[MisfitGroup.AFFINE].start, GROUP_COLUMNS[MisfitGroup.PRINCIPAL_POINT].start
    out[:, affine, 0], out[:, affine, 1] = 0.5 * width - cx, half
    out[:, affine + 1, 0], out[:, affine + 1, 1] = fx / fy * (0.5 * height - cy), fx / fy * half
    out[:, shift, 0], out[:, shift + 1, 0] = fx, fy
    out[:, NUM_FIELDS + 3] = out[:, affine]
    return out


def _fields_of(factor: FloatArray) -> FloatArray:
    """(B, 44, 48) the same as a matrix, fields as its columns."""
    out = np.zeros((len(factor), FIELDS, len(_TERMS)))
    for term in range(_TERMS.shape[1]):
        has = np.flatnonzero(_TERMS[:, term] >= 0)
        out[:, _TERMS[has, term], has] = factor[:, has, term]
    return out


def _lenses(cameras: Sequence[CameraRecord]) -> FloatArray:
    """(B, 6) fx, fy, cx, cy, width, height."""
    out = []
    for camera in cameras:
        params, focals, centre = camera.params.tolist(), camera.model.focal_idxs, camera.model.principal_point_idxs
        lens = params[focals[0]], params[focals[-1]], params[centre[0]], params[centre[-1]]
        out.append((*lens, camera.width, camera.height))
    return np.array(out, dtype=np.float64).reshape(-1, 6)


def _squares(plain: FloatArray, dense_plain: FloatArray) -> FloatArray:
    """(.., 44, 44) w E^T E, as far as lengths of fields need it: none mixes a dense function with any other."""
    out = np.zeros((*plain.shape[:-2], FIELDS, FIELDS))
    out[..., :SCALAR, :SCALAR] = out[..., SCALAR:_BOTH, SCALAR:_BOTH] = plain
    dense = np.arange(_BOTH, FIELDS)
    out[..., dense, dense] = dense_plain
    return out
