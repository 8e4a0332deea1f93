"""Is a camera wrong that several images share? Scores pooled over its images (method.md section 5, *Cameras*).

The nuisances are the poses of all images and, once, the fitted intrinsics; every candidate field is one column over all
images. Nothing of size observations x images is ever built: one pass accumulates the normal matrices of what is left
of intrinsics and fields after each image's own pose, a second pass the scores of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.design import ImageDesign, OffPose, Piece, piece_of, remembered
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS
from sfm_audit.audit.misfit.outcome import MisfitTest, MisfitTests, judged_by_chi2, not_tested, refusal
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray

_SMALLEST_PIVOT: Final = 1e-8  # of the intrinsics' normal matrix, unit columns: below it, the triangular factor by QR


@dataclass(frozen=True, slots=True, eq=False)
class PooledTests:
    """The tests of one camera; how many images (with observations), observations and tracks took part, 0 if none."""

    tests: MisfitTests
    num_images: int
    num_observations: int
    num_tracks: int


def camera_tests(
    designs: Callable[[int], ImageDesign], num_images: int, num_tracks: int, *, exact: bool = False
) -> PooledTests:
    """Test a camera on all its images at once.

    Parameters
    ----------
    designs : gives image 0 .. num_images - 1; called twice for each (three times if a rank is in doubt), so that only
        one image needs to be in memory
    num_tracks : tracks are numbered below it; those without observations do not count
    exact : take the triangular factor by QR instead of from normal matrices

    Returns
    -------
    PooledTests
        Not enough evidence with fewer than 4 r tracks.

    Notes
    -----
    H0: residuals are independent between tracks (not within), with mean zero off the nuisances. T = s^T M^-1 s against
    chi^2(r), which needs many tracks: unlike the test of one image it is not exact under Gaussian noise.

    Memory: 8 bytes x 42 x num_tracks for the scores, beside one image's columns.
    """
    return camera_tests_of_pieces(lambda i: piece_of(designs(i)), num_images, num_tracks, exact=exact)


def camera_tests_of_pieces(
    pieces: Callable[[int], Piece], num_images: int, num_tracks: int, *, exact: bool
) -> PooledTests:
    """Return `camera_tests`, from images whose poses are profiled; ``pieces`` is called as ``designs`` there."""
    pieces = remembered(pieces)
    normal = _first_pass(pieces, num_images, num_tracks)
    if isinstance(normal, MisfitStatus):
        return PooledTests({group: not_tested(normal) for group in GROUPS}, 0, 0, 0)
    solution = None if exact else solve_normal(normal)
    if solution is None:
        parts = (part for part in (pieces(i).part for i in range(num_images)) if part is not None)
        solution = solve_triangle(triangle_of(parts, normal), normal)
    return _second_pass(pieces, num_images, num_tracks, normal, solution)


@dataclass(frozen=True, slots=True, eq=False)
class PooledNormal:
    """What the first pass leaves; C: the k intrinsics, E: the fields, both off the poses and of unit length before.

    gram: (k + 42, k + 42) of [C, E].          before: (k + 42, k + 42) the same before projection.
    on_y: (k + 42,) [C, E]^T y.                scale: (k + 42,) 1 / length before projection, 0 for zero columns.
    refused: groups with derivatives that are not finite.    num_free: values that the poses leave free.
    """

    gram: FloatArray
    before: FloatArray
    on_y: FloatArray
    scale: FloatArray
    refused: frozenset[MisfitGroup]
    num_free: int
    num_images: int
    num_observations: int
    num_tracks: int

    @property
    def num_intrinsics(self) -> int:
        """K, the intrinsics in front of the fields."""
        return len(self.scale) - NUM_FIELDS

    def columns(self, group: MisfitGroup) -> slice:
        """Of a group, behind the intrinsics."""
        own = GROUP_COLUMNS[group]
        return slice(own.start + self.num_intrinsics, own.stop + self.num_intrinsics)


@dataclass(frozen=True, slots=True, eq=False)
class PooledSolution:
    """How to go from C and E to orthonormal columns.

    to_basis: (k, k') C to_basis is an orthonormal basis Qc of the intrinsics.    on_basis: (k', 42) Qc^T E.
    transform: U = (E - Qc on_basis) transform per group, (c, r).
    """

    to_basis: FloatArray
    on_basis: FloatArray
    transform: dict[MisfitGroup, FloatArray]


class PooledSums:
    """The first pass, image by image."""

    def __init__(self, num_intrinsics: int, num_tracks: int) -> None:
        size = num_intrinsics + NUM_FIELDS
        self.gram, self.before, self.on_y = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
        self.finite = np.ones(size, dtype=np.bool_)
        self.seen = np.zeros(num_tracks, dtype=np.bool_)
        self.num_images = self.num_observations = self.num_free = 0

    def add(self, part: OffPose, track: IntArray) -> None:
        """Add an image, or a part of one (the coordinates then once), whose observations belong to ``track`` (n,)."""
        own = part.columns @ part.columns.T
        self.gram += own
        self.before += own + part.coordinates @ part.coordinates.T
        self.on_y += part.columns @ part.y
        self.finite &= part.finite
        self.seen[track] = True
        self.num_images += 1
        self.num_observations += len(track)
        self.num_free += len(part.y) - part.coordinates.shape[1]

    def normal(self) -> PooledNormal:
        """Scale to columns of unit length."""
        length = np.sqrt(np.diagonal(self.before))
        scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
        both = scale * scale[:, None]
        of_fields = self.finite[len(scale) - NUM_FIELDS :]
        return PooledNormal(
            self.gram * both,
            self.before * both,
            self.on_y * scale,
            scale,
            frozenset(group for group, columns in GROUP_COLUMNS.items() if not of_fields[columns].all()),
            self.num_free,
            self.num_images,
            self.num_observations,
            int(np.count_nonzero(self.seen)),
        )


def _first_pass(
    pieces: Callable[[int], Piece], num_images: int, num_tracks: int
) -> PooledNormal | Literal[MisfitStatus.NO_FIELDS, MisfitStatus.NOT_FINITE, MisfitStatus.NOT_ENOUGH_EVIDENCE]:
    """Accumulate over images; or say why nothing can be tested."""
    sums: PooledSums | None = None
    for i in range(num_images):
        piece = pieces(i)
        if not piece.has_fields:
            return MisfitStatus.NO_FIELDS
        if not len(piece.track):
            continue
        if piece.part is None or not piece.part.finite[: piece.num_intrinsics].all():
            return MisfitStatus.NOT_FINITE
        sums = sums or PooledSums(piece.num_intrinsics, num_tracks)
        sums.add(piece.part, piece.track)
        del piece  # before the next image's columns are made
    if sums is None:
        return MisfitStatus.NOT_ENOUGH_EVIDENCE
    return sums.normal() if np.isfinite(sums.before).all() else MisfitStatus.NOT_FINITE


def _largest_sq(normal: PooledNormal, group: MisfitGroup) -> float:
    """Largest squared singular value of a group before projection."""
    columns = normal.columns(group)
    return basis.largest_sq(normal.before[columns, columns])


def solve_normal(normal: PooledNormal) -> PooledSolution | None:
    """Solve through the normal matrices; None where they leave a rank in doubt."""
    k = normal.num_intrinsics
    used = normal.scale[:k] > 0
    to_basis = np.zeros((k, int(np.count_nonzero(used))))
    if used.any():
        values, vectors = np.linalg.eigh(normal.gram[:k, :k][np.ix_(used, used)])
        if values[0] <= _SMALLEST_PIVOT:
            return None
        to_basis[used] = vectors / np.sqrt(values)
    on_basis = to_basis.T @ normal.gram[:k, k:]
    left = normal.gram[k:, k:] - on_basis.T @ on_basis
    transforms = {}
    for group in GROUPS:
        if group in normal.refused:
            continue
        columns, own = GROUP_COLUMNS[group], normal.columns(group)
        transform = basis.field_transform(left[columns, columns], normal.before[own, own])
        if transform is None:
            return None
        transforms[group] = transform
    return PooledSolution(to_basis, on_basis, transforms)


def triangle_of(parts: Iterable[OffPose], normal: PooledNormal) -> FloatArray:
    """(k + 42, k + 42) R with R^T R the normal matrix, without squaring anything: QR of one image after the other."""
    triangle = np.zeros((0, len(normal.scale)))
    for part in parts:
        rows = (part.columns * normal.scale[:, None]).T
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, rows]), mode="r"))
    return triangle


def solve_triangle(triangle: FloatArray, normal: PooledNormal) -> PooledSolution:
    """Solve as the dense problem is solved, with the triangle in the place of the columns."""
    k = normal.num_intrinsics
    left, singular, right = np.linalg.svd(triangle[:, :k], full_matrices=False)
    threshold = basis.NUISANCE_THRESHOLD * math.sqrt(float(np.linalg.eigvalsh(normal.before[:k, :k])[-1])) if k else 0.0
    kept = singular > threshold
    q = left[:, kept]
    on_basis = q.T @ triangle[:, k:]
    fields = triangle[:, k:] - q @ on_basis
    again = q.T @ fields
    fields = fields - q @ again
    transforms = {}
    for group in GROUPS:
        if group in normal.refused:
            continue
        _, lengths, vectors = np.linalg.svd(fields[:, GROUP_COLUMNS[group]], full_matrices=False)
        sure = lengths > basis.FIELD_THRESHOLD * math.sqrt(_largest_sq(normal, group))
        transforms[group] = vectors[sure].T / lengths[sure]
    return PooledSolution(right[kept].T / singular[kept], on_basis + again, transforms)


def _second_pass(
    pieces: Callable[[int], Piece],
    num_images: int,
    num_tracks: int,
    normal: PooledNormal,
    solution: PooledSolution,
) -> PooledTests:
    """Sum scores and, per track, what the meat is made of; judge."""
    per_track, scores = np.zeros((num_tracks, NUM_FIELDS)), np.zeros(NUM_FIELDS)
    last_row = np.empty(num_tracks, dtype=np.int64)
    for i in range(num_images):
        piece = pieces(i)
        if piece.part is None:
            continue
        own_scores, per_observation = scored(piece.part, normal, solution)
        scores += own_scores
        add_rows(per_track, piece.track, per_observation, last_row)
        del piece, per_observation  # before the next image's columns are made
    meat = per_track.T @ per_track
    tests = {group: judged(group, scores, meat, normal, solution) for group in GROUPS}
    return PooledTests(tests, normal.num_images, normal.num_observations, normal.num_tracks)


def scored(part: OffPose, normal: PooledNormal, solution: PooledSolution) -> tuple[FloatArray, FloatArray]:
    """Return the scores (42,) of an image's columns, which are used up, and (n, 42) what its observations add to them.

    The second is weighted by 1 / sqrt(1 - leverage): what the meat is made of.
    """
    k = normal.num_intrinsics
    part.columns[...] *= normal.scale[:, None]
    qc = solution.to_basis.T @ part.columns[:k]
    fields = part.columns[k:]
    fields -= solution.on_basis.T @ qc
    y = part.y - (solution.to_basis.T @ normal.on_y[:k]) @ qc
    leverage = np.minimum(part.pose_leverage + np.einsum("qm,qm->m", qc, qc), basis.MAX_LEVERAGE)
    weighted = (y / np.sqrt(1.0 - leverage)).reshape(2, -1)
    return fields @ y, np.einsum("cin,in->nc", fields.reshape(len(fields), 2, -1), weighted)


def add_rows(target: FloatArray, rows: IntArray | Int32Array, values: FloatArray, last_row: IntArray) -> None:
    """Add values (n, c) to rows of target in place, also where a track is seen twice; last_row: scratch."""
    number = np.arange(len(rows))
    last_row[rows] = number
    if (last_row[rows] == number).all():
        sums = target.take(rows, axis=0)
        sums += values
        target[rows] = sums
    else:
        np.add.at(target, rows, values)


def judged(
    group: MisfitGroup, scores: FloatArray, meat: FloatArray, normal: PooledNormal, solution: PooledSolution
) -> MisfitTest:
    """Return the test of one group from the sums over all images."""
    if group in normal.refused:
        return not_tested(MisfitStatus.NOT_FINITE)
    columns, transform = GROUP_COLUMNS[group], solution.transform[group]
    if normal.num_free - solution.to_basis.shape[1] < columns.stop - columns.start:
        return not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE)
    refused = refusal(transform.shape[1], normal.num_tracks)
    if refused is not None:
        return refused
    own_meat = transform.T @ meat[columns, columns] @ transform
    return judged_by_chi2(transform.T @ scores[columns], own_meat, normal.num_observations)
