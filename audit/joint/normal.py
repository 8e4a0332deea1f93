"""The normal equations without the points: S and g (method.md (6))."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy import sparse

from sfm_audit.audit.joint.design import AT_ONCE
from sfm_audit.audit.joint.layout import NUM_POSE, Layout
from sfm_audit.audit.joint.matrix import PairMatrix, Symmetric
from sfm_audit.audit.joint.neighbourhood import Neighbourhood, neighbourhood, point_chunks, sum_by_track
from sfm_audit.audit.joint.observations import JointObservations, design_crossed, point_information
from sfm_audit.audit.joint.sums import has_joint_sums, joint_sums
from sfm_audit.audit.kernels.joint import JointSums
from sfm_audit.audit.kernels.joint_matrix import Blocks
from sfm_audit.audit.kernels.joint_normal import OtherSystem, PairBlocks, meats, normals
from sfm_audit.audit.kernels.joint_parts import two_informations, unit_determinants
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import FloatArray, IntArray, distinct

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class ReducedSystem:
    """S step = g over the D columns of the layout.

    point_inverse: (P, 3, 3) V^-1; zero without observations, and where points are independent.
    matrix: (D, D) S.    right: (D,) g.    before: (D,) diagonal of B, what S had without the elimination of points.
    """

    point_inverse: FloatArray
    matrix: Symmetric
    right: FloatArray
    before: FloatArray


def reduced_systems(
    observations: JointObservations, values_px: FloatArray | None = None
) -> tuple[ReducedSystem, ReducedSystem]:
    """Assemble (6) with the robust weights and with w = 1.

    Parameters
    ----------
    values_px : (n, 2) residuals of the observations, where they are at hand
    """
    values_px = observations.residuals_px() if values_px is None else values_px
    compiled = _compiled_systems(observations, values_px)
    if compiled is not None:
        return compiled
    weights = observations.weight, observations.plain_weight
    inverses = _point_inverses(observations, weights)
    cleaned = [off_points(observations, *pair, values_px) for pair in zip(weights, inverses, strict=True)]
    layout = observations.layout
    right, before = np.zeros((2, layout.num_columns + 1)), np.zeros((2, layout.num_columns + 1))
    blocks = _Blocks(layout.num_columns), _Blocks(layout.num_columns)
    for image in observations.used_images:
        rows, columns = observations.rows(image), layout.columns[image]
        for part in observations.parts(image):
            own = observations.nuisance(image, part)
            for k, weight in enumerate(weights):
                weighted = (own * weight[rows][part, None, None]).reshape(-1, layout.width)
                gram = weighted.T @ own.reshape(-1, layout.width)
                np.add.at(right[k], columns, cleaned[k][rows][part].reshape(-1) @ weighted)
                np.add.at(before[k], columns, gram.diagonal())
                blocks[k].add(columns, columns[None], 0.5 * gram[None])
    del cleaned, values_px
    if not observations.points_independent:
        _eliminate_points(observations, inverses, blocks)
    robust, plain = (
        ReducedSystem(inverses[k], blocks[k].matrix(), right[k, :-1], before[k, :-1]) for k in range(len(weights))
    )
    return robust, plain


def _compiled_systems(
    observations: JointObservations, values_px: FloatArray
) -> tuple[ReducedSystem, ReducedSystem] | None:
    """The same by the compiled sums."""
    layout, images = observations.layout, np.array(observations.used_images, dtype=np.int64)
    if not has_joint_sums(observations):
        return None
    design, weight = observations.design.kept, observations.weight
    with np.errstate(divide="ignore"):  # of images that have no columns
        of_images = 1.0 / observations.sigma_px**2
    by_point = two_informations(observations.index, design, weight, of_images, values_px)
    if by_point is None:
        return None
    inverses = [_inverted(each) for each in by_point.informations]
    sums = joint_sums(observations, values_px, weight, inverses[0])
    if sums is None:
        return None
    other = OtherSystem(of_images, inverses[1], by_point.pulls)
    found = _of_images(observations, images, lambda some: normals(sums, some, observations.transform, other))
    if not found:
        return None
    own_columns = layout.columns[images]
    grams, rights = (np.concatenate([each[k] for each in found]) for k in (1, 2))
    systems = []
    for k, inverse in enumerate(inverses):
        right, before = np.zeros((2, layout.num_columns + 1))
        np.add.at(right, own_columns, rights[:, k])
        np.add.at(before, own_columns, np.einsum("iaa->ia", grams[:, k]))
        matrix = _of_pairs(layout, images, [each.pairs for each in found], k)
        systems.append(ReducedSystem(inverse, matrix, right[:-1], before[:-1]))
    return systems[0], systems[1]


def _of_images(observations: JointObservations, images: IntArray, compiled: Callable[[IntArray], T | None]) -> list[T]:
    """What a kernel says of ranges of images; nothing where it leaves one of them out."""
    counts = np.diff(observations.offsets)[images]
    parts = over_ranges(lambda start, stop: compiled(images[start:stop]), len(images), counts)
    found = [part for part in parts if part is not None]
    return found if len(found) == len(parts) else []


def _of_pairs(layout: Layout, images: IntArray, pairs: Sequence[PairBlocks], system: int) -> PairMatrix:
    """The matrix of the blocks of all images (k,)."""
    counts = np.concatenate([each.counts for each in pairs])
    columns = np.repeat(layout.columns[images], counts, axis=0)
    others = layout.columns[np.concatenate([each.around for each in pairs])]
    slabs = np.concatenate([each.slabs[system] for each in pairs])
    marks = (0, NUM_POSE) if layout.width > NUM_POSE else (0,)
    return PairMatrix(Blocks(layout.num_columns, others, columns, slabs), layout.group_of_column(), marks)


def _eliminate_points(
    observations: JointObservations, inverses: list[FloatArray], blocks: tuple[_Blocks, _Blocks]
) -> None:
    """Subtract half of sum W V^-1 W^T, image by image: each pair of images that share points once."""
    layout, transform = observations.layout, observations.transform
    to_plain = observations.plain_weight / observations.weight
    for image, around in _neighbourhoods(observations):
        track = around.track[: around.starts[1]]  # its own views come first
        crossed = design_crossed(*observations.weighted(around.views))
        columns, others = layout.columns[image], layout.columns[around.images]
        for k, inverse in enumerate(inverses):
            if k == 1:
                crossed *= to_plain[around.views, None, None]
            own = sum_by_track(crossed[: len(track)] @ transform[image], track, around.points.size)
            eliminated = inverse[around.points] @ own  # V^-1 W^T
            slab = transform[around.images].transpose(0, 2, 1) @ around.gather(crossed, eliminated)
            slab[0] *= 0.5
            blocks[k].add(columns, others, -slab.transpose(0, 2, 1))


def _neighbourhoods(observations: JointObservations) -> Iterator[tuple[int, Neighbourhood]]:
    """Each image with the views of its points, its own and those of images behind it; a bounded number at a time."""
    for image in observations.used_images:
        points = distinct(observations.point_idx[observations.rows(image)]).astype(np.int64)
        for chunk in point_chunks(observations, points):
            yield image, neighbourhood(observations, points[chunk]).from_image(image)


def score_meat(observations: JointObservations, left_px: FloatArray) -> Symmetric:
    """Return M (D, D): sum over tracks of g_t g_t^T, with g_t the score of the base system from track t.

    Parameters
    ----------
    left_px : (n, 2) y~, the residuals after the step; they are off J, so g_t is the sum of w N^T y~ over the views
    """
    layout, transform = observations.layout, observations.transform
    nothing = np.zeros((observations.num_points, 3, 3))
    sums = joint_sums(observations, left_px, observations.weight, nothing)
    compiled = None if sums is None else _compiled_meat(observations, sums)
    if compiled is not None:
        return compiled
    blocks = _Blocks(layout.num_columns)
    for image, around in _neighbourhoods(observations):
        track = around.track[: around.starts[1]]
        score = observations.scores(around.views, left_px)
        own = sum_by_track(score[: len(track)] @ transform[image], track, around.points.size)
        slab = transform[around.images].transpose(0, 2, 1) @ around.gather(score[:, None, :], own[:, None, :])
        slab[0] *= 0.5
        blocks.add(layout.columns[image], layout.columns[around.images], slab.transpose(0, 2, 1))
    return blocks.matrix()


def _compiled_meat(observations: JointObservations, sums: JointSums) -> PairMatrix | None:
    layout, images = observations.layout, np.array(observations.used_images, dtype=np.int64)
    found = _of_images(observations, images, lambda some: meats(sums, some, observations.transform))
    return _of_pairs(layout, images, found, 0) if found else None


def off_points(
    observations: JointObservations, weight: FloatArray, point_inverse: FloatArray, values_px: FloatArray
) -> FloatArray:
    """Return values (n, 2) minus what moving the points alone would remove: J V^-1 J^T w."""
    if observations.points_independent:
        return values_px
    step = point_steps(observations, weight, point_inverse, values_px)
    jacobian, source = observations.residuals.point_jacobian, observations.source
    out = values_px.copy()
    for i in range(3):
        moved = step[observations.point_idx, i]
        out[:, 0] -= jacobian[0, i].take(source) * moved
        out[:, 1] -= jacobian[1, i].take(source) * moved
    return out


def point_steps(
    observations: JointObservations, weight: FloatArray, point_inverse: FloatArray, values_px: FloatArray
) -> FloatArray:
    """Return (P, 3): where values (n, 2) pull the points, V^-1 J^T w, world frame."""
    jacobian, source = observations.residuals.point_jacobian, observations.source
    pull = np.empty((observations.num_points, 3))
    for i in range(3):
        along = jacobian[0, i].take(source) * values_px[:, 0] + jacobian[1, i].take(source) * values_px[:, 1]
        pull[:, i] = np.bincount(observations.point_idx, along * weight, observations.num_points)
    return np.asarray(np.einsum("pij,pj->pi", point_inverse, pull))


def _point_inverses(observations: JointObservations, weights: tuple[FloatArray, FloatArray]) -> list[FloatArray]:
    """V^-1 (P, 3, 3) with either weight."""
    if observations.points_independent:
        return [np.zeros((observations.num_points, 3, 3)) for _ in weights]
    return [_inverted(_information(observations, weight)) for weight in weights]


def _information(observations: JointObservations, weight: FloatArray) -> FloatArray:
    everywhere = np.zeros(observations.residuals.point_idx.size)
    everywhere[observations.source] = weight
    jacobian, point_idx = observations.residuals.point_jacobian, observations.residuals.point_idx
    return point_information(jacobian, everywhere, point_idx, len(observations.model.points))[0][observations.points]


def _inverted(information: FloatArray) -> FloatArray:
    """In place."""
    if unit_determinants(information, smallest=0.0, invert=True) is not None:
        return information
    for start in range(0, len(information), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        scale = np.sqrt(np.einsum("pii->pi", information[part]))
        unit = information[part] / scale[:, :, None] / scale[:, None, :]
        information[part] = np.linalg.inv(unit) / scale[:, :, None] / scale[:, None, :]
    return information


class _Blocks:
    """A sparse symmetric matrix A + A^T; A is collected block by block, the column behind the last one is padding."""

    def __init__(self, num_columns: int) -> None:
        self._num_columns = num_columns
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []
        self._values: list[FloatArray] = []
        self._sum: sparse.csr_array | None = None
        self._pending = 0

    def add(self, rows: IntArray, columns: IntArray, blocks: FloatArray) -> None:
        """Add blocks (m, r, c) at rows (r,) and columns (m, c)."""
        row = np.broadcast_to(rows[None, :, None], blocks.shape)
        column = np.broadcast_to(columns[:, None, :], blocks.shape)
        real = (row < self._num_columns) & (column < self._num_columns)
        self._rows.append(row[real].astype(np.int32))
        self._columns.append(column[real].astype(np.int32))
        self._values.append(blocks[real])
        self._pending += self._values[-1].size
        if self._pending > 1_000_000:
            self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        shape = (self._num_columns, self._num_columns)
        index = (np.concatenate(self._rows), np.concatenate(self._columns))
        part = sparse.coo_array((np.concatenate(self._values), index), shape=shape).tocsr()
        self._sum = part if self._sum is None else self._sum + part
        self._rows, self._columns, self._values, self._pending = [], [], [], 0

    def matrix(self) -> sparse.csr_array:
        """The sum of all blocks and of their transposes."""
        self._flush()
        shape = (self._num_columns, self._num_columns)
        return sparse.csr_array(shape) if self._sum is None else sparse.csr_array(self._sum + self._sum.T)
