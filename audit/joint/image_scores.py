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
from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct
from sfm_audit.loaders.model import CameraRecord, ImageRecord, rotation_from_quat

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
    weights, inverses = (base.observations.weight,), (base.point_inverse,)
    return joint_sums(base.observations, base.left_px, weights, inverses, included)


def image_scores(
    system: JointSystem, base: Base, sums: JointSums, image_idx: int, power: int
) -> CandidateScores | None:
    """Return the scores of an image's candidate fields; None where the numpy path has to be taken.

    Parameters
    ----------
    sums : of the same base        power : of r^2 in the radial term of the missing parameters, 0 without these
    """
    observations = base.observations
    image = system.model.image(image_idx)
    camera = image.camera
    if camera is None or not follows_the_lens(camera.model) or not sums.can(image_idx):
        return None
    fields = sums.fields(
        image_idx, *_inputs(system, image_idx, camera), is_fisheye=is_fisheye(camera.model), power=power
    )
    if fields is None:
        return None
    tracks = sums.tracks(image_idx)
    half = sums.first(image_idx, *fields, tracks)
    if half is None:
        return None
    placed = _Placed(base, half.around)
    right = placed.collected(half.right)
    solution = base.inverse.within(placed.support, right)
    sums.second(half, tracks, placed.spread(solution))
    made_of = _fields(camera, power)
    with np.errstate(over="ignore", invalid="ignore"):
        gram = half.gram - right.T @ solution
        meat = half.track_score.T @ half.track_score
        if not (np.isfinite(gram).all() and np.isfinite(meat).all()):
            return None  # numpy keeps what is not finite to the fields that it belongs to
        squares = _squares(half.plain, half.dense_plain)
        sq_length = ((squares @ made_of) * made_of).sum(axis=0)
        if not (sq_length >= _LEFT_OF_TERMS * (squares.diagonal() @ made_of**2)).all():
            return None  # functions that all but cancel, of an image that is a dot in the middle of nowhere
        gram, meat = (made_of.T @ each @ made_of for each in (0.5 * (gram + gram.T), meat))
    score = half.score @ made_of
    of_fields = sq_length, gram, score, meat, tracks[1]
    return CandidateScores(*of_fields, right, placed.support, solution, observations.num_of(image_idx), made_of)


class ScoresOfMany:
    """`image_scores` of many images in one call of a kernel.

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
        """Return the scores of some images; None where `image_scores` has to be asked, or who comes after it.

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


def scores_of_many(system: JointSystem, base: Base, sums: JointSums | None) -> ScoresOfMany | None:
    """Return who asks about many images at once; None where each has to be asked by itself."""
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


def _inputs(system: JointSystem, image_idx: int, camera: CameraRecord) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Facts (27,) of `JointSums.fields`, xyz_world (n, 3), predicted xy_px (n, 2)."""
    observations, residuals = system.observations, system.residuals
    source = observations.source[observations.rows(image_idx)]
    image = system.model.image(image_idx)
    focals = camera.params[list(camera.model.focal_idxs)]
    width, height = camera.width, camera.height
    size = [focals[0], focals[-1], 0.5 * width, 0.5 * height, 0.5 * max(width, height), height]
    inverse = _world_from_cam(system.base, image, image_idx)
    pose = image.rotation_cam_from_world.ravel(), image.translation_cam_from_world
    facts = np.concatenate([*pose, size, inverse.ravel()])
    xyz_world = system.model.points.xyz_world.take(residuals.point_idx[source], axis=0)
    observed = system.model.observations.xy_px.take(residuals.observation_row[source], axis=0)
    return facts, xyz_world, observed - residuals.residuals_px.take(source, axis=1).T


def _world_from_cam(base: Base, image: ImageRecord, image_idx: int) -> FloatArray:
    """(3, 3) inverse of an image's rotation."""
    observations = base.observations
    if not observations.layout.has_rigs:
        return np.asarray(observations.transform[image_idx][POINT, POINT])
    return np.asarray(np.linalg.pinv(image.rotation_cam_from_world))


def _fields(camera: CameraRecord, power: int) -> FloatArray:
    """(44, c) of which functions the candidate fields are made, then the missing parameters'."""
    out = _fields_of([camera])[0]
    return out if power else np.ascontiguousarray(out[:, :NUM_FIELDS])


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
    """(.., 44, 44) w E^T E, as far as lengths of fields need it: no field mixes dense functions with scalar ones."""
    out = np.zeros((*plain.shape[:-2], FIELDS, FIELDS))
    out[..., :SCALAR, :SCALAR] = out[..., SCALAR:_BOTH, SCALAR:_BOTH] = plain
    out[..., _BOTH:, _BOTH:] = dense_plain
    return out


class _Placed:
    """Where the images around have their columns in the base.

    support: (s,) columns of the base, ascending, those of included fields last.
    """

    def __init__(self, base: Base, around: IntArray) -> None:
        layout = base.observations.layout
        self._around, self._transform = around, base.observations.transform[around]
        self._extra = [base.included[image].columns for image in around.tolist() if image in base.included]
        self._is_extra = np.array([image in base.included for image in around.tolist()], dtype=bool)
        columns = layout.columns[around]
        self._real = (columns < layout.num_columns).ravel()
        own = columns.ravel()[self._real]
        distinct_own = distinct(own)
        self._is_unique = distinct_own.size == own.size
        self._place = np.searchsorted(distinct_own, own)
        self._num_own, self._width = distinct_own.size, layout.width
        order = sorted(range(len(self._extra)), key=lambda k: int(self._extra[k][0]))
        self.support = np.concatenate([distinct_own, *(self._extra[k] for k in order)])
        starts = np.cumsum([distinct_own.size, *(self._extra[k].size for k in order)]).tolist()
        self._extra_place = {k: slice(starts[n], starts[n + 1]) for n, k in enumerate(order)}

    def _rows(self) -> tuple[IntArray, list[slice]]:
        """First rows of the design's columns of each image around (m,), and the rows of its included fields."""
        sizes = np.full(len(self._around), self._width)
        sizes[self._is_extra] += np.array([columns.size for columns in self._extra], dtype=np.int64)
        starts = np.cumsum(sizes) - sizes
        behind = starts[self._is_extra] + self._width
        return starts, [
            slice(start, start + columns.size) for start, columns in zip(behind.tolist(), self._extra, strict=True)
        ]

    def collected(self, right: FloatArray) -> FloatArray:
        """(s, F) R of (rows, F) as `JointSums.first` has it."""
        count = right.shape[1]
        starts, behind = self._rows()
        own = right if not self._extra else right[(starts[:, None] + np.arange(self._width)).ravel()]
        turned = self._transform.transpose(0, 2, 1) @ own.reshape(-1, self._width, count)
        rows = turned.reshape(-1, count)[self._real]
        out = np.zeros((self.support.size, count))
        if self._is_unique:
            out[self._place] = rows
        else:
            np.add.at(out, self._place, rows)
        for k, rows_of in enumerate(behind):
            out[self._extra_place[k]] = right[rows_of]
        return out

    def spread(self, solution: FloatArray) -> FloatArray:
        """(rows, F) T B of each image around, in the order of `JointSums.first`, of B (s, F)."""
        count = solution.shape[1]
        own = np.zeros((self._real.size, count))
        own[self._real] = solution[self._place]
        moved = (self._transform @ own.reshape(-1, self._width, count)).reshape(-1, count)
        if not self._extra:
            return moved
        starts, behind = self._rows()
        out = np.empty((len(moved) + sum(columns.size for columns in self._extra), count))
        out[(starts[:, None] + np.arange(self._width)).ravel()] = moved
        for k, rows_of in enumerate(behind):
            out[rows_of] = solution[self._extra_place[k]]
        return out
