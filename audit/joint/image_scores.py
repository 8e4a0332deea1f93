"""`candidate_scores` of one image through the compiled sums.

All candidate fields of an image are made of fewer functions than there are fields: scalars along x and the same along y
(the principal point, the affine and the smooth fields), and some with both components. The sums are those of these 44;
the fields' follow by a small matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.projection import is_fisheye
from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.design import POINT
from sfm_audit.audit.joint.sums import joint_sums
from sfm_audit.audit.joint.system import Base, JointSystem
from sfm_audit.audit.kernels.joint import FIELDS, SCALAR, JointSums
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
        cameras = [self._system.model.camera(int(self._system.observations.layout.camera_idx[i])) for i in images]
        asked = [k for k, i in enumerate(images) if follows_the_lens(cameras[k].model) and self._sums.can(i)]
        if not asked:
            return out
        chosen = np.array([images[k] for k in asked], dtype=np.int64)
        power = np.array([powers[k] for k in asked], dtype=np.int64)
        of_asked = [cameras[k] for k in asked]
        found = self._kernel.of(asked_of(self._system, chosen, of_asked, power))
        if found is None:
            return out
        for k, each in zip(asked, self._told(chosen, power, _fields_of(of_asked), found), strict=True):
            out[k] = each
        return out

    def _told(
        self, images: IntArray, power: IntArray, made_of: FloatArray, found: Scores
    ) -> list[CandidateScores | None]:
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
    return np.asarray(_fields_of([camera])[0, :, NUM_FIELDS:])


def _facts(system: JointSystem, images: IntArray, cameras: Sequence[CameraRecord]) -> FloatArray:
    """(k, 27) facts of `JointSums.fields`."""
    table = system.model.images
    rotation = rotation_from_quat(table.quat_cam_from_world_wxyz[images])
    size = [
        (*camera.params[list(camera.model.focal_idxs)][[0, -1]].tolist(), camera.width, camera.height)
        for camera in cameras
    ]
    fx, fy, width, height = np.array(size, dtype=np.float64).reshape(-1, 4).T
    if system.observations.layout.has_rigs:
        inverse = np.linalg.pinv(rotation)
    else:
        inverse = system.observations.transform[images][:, POINT, POINT]
    lens = np.stack([fx, fy, 0.5 * width, 0.5 * height, 0.5 * np.maximum(width, height), height], axis=1)
    pose = rotation.reshape(-1, 9), table.translation_cam_from_world[images]
    return np.concatenate([*pose, lens, inverse.reshape(-1, 9)], axis=1)


def _fields_of(cameras: Sequence[CameraRecord]) -> FloatArray:
    """(B, 44, 48) the same of some cameras, the missing parameters included."""
    out = np.zeros((len(cameras), FIELDS, NUM_FIELDS + _MISSING))
    numbers = [
        (*(camera.params[list(idxs)][[0, -1]] for idxs in _of_camera(camera)), camera.width, camera.height)
        for camera in cameras
    ]
    (fx, fy), (cx, cy) = (np.array([each[k] for each in numbers]).reshape(-1, 2).T for k in range(2))
    width, height = np.array([each[2:] for each in numbers], dtype=np.float64).reshape(-1, 2).T
    half = 0.5 * np.maximum(width, height)
    radial, tangential, affine, shift, rolling, smooth = (
        GROUP_COLUMNS[group].start
        for group in (
            *(MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE, MisfitGroup.PRINCIPAL_POINT),
            *(MisfitGroup.ROLLING_SHUTTER, MisfitGroup.SMOOTH),
        )
    )
    for k in range(2):
        out[:, _BOTH + k, radial + k] = 1.0
        out[:, _BOTH + 2 + k, tangential + k] = 1.0
    out[:, _X, affine], out[:, _X + 1, affine] = 0.5 * width - cx, half  # fx v_x = x - cx
    out[:, _X, affine + 1], out[:, _X + 2, affine + 1] = fx / fy * (0.5 * height - cy), fx / fy * half
    out[:, _X, shift], out[:, _Y, shift + 1] = fx, fy
    out[:, _ROLLING : _ROLLING + 6, rolling : rolling + 6] = np.eye(6)
    for k in range(SCALAR - 2):
        out[:, _X + 1 + k, smooth + k] = 1.0
        out[:, _Y + 1 + k, smooth + SCALAR - 2 + k] = 1.0
    last = NUM_FIELDS
    out[:, _X, last], out[:, _Y, last + 1], out[:, _NEXT, last + 2] = 1.0, 1.0, 1.0
    out[:, :, last + 3] = out[:, :, affine]
    out[:, :, last + 4 : last + 6] = out[:, :, tangential : tangential + 2]
    return out


def _of_camera(camera: CameraRecord) -> tuple[Sequence[int], Sequence[int]]:
    """Which of its parameters are focal lengths and the principal point."""
    return camera.model.focal_idxs, camera.model.principal_point_idxs


def _squares(plain: FloatArray, dense_plain: FloatArray) -> FloatArray:
    """(.., 44, 44) w E^T E, as far as lengths of fields need it: none mixes a dense function with any other."""
    out = np.zeros((*plain.shape[:-2], FIELDS, FIELDS))
    out[..., :SCALAR, :SCALAR] = out[..., SCALAR:_BOTH, SCALAR:_BOTH] = plain
    dense = np.arange(_BOTH, FIELDS)
    out[..., dense, dense] = dense_plain
    return out
