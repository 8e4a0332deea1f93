"""The normal equations without the points: S and g (method.md (6))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from audit.joint.neighbourhood import neighbourhood, sum_by_track
from audit.joint.observations import JointObservations, point_information
from loaders.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ReducedSystem:
    """S step = g over the D columns of the layout.

    point_inverse: (P, 3, 3) V^-1; zero without observations, and where points are independent.
    matrix: (D, D) S.    right: (D,) g.    before: (D,) diagonal of B, what S had without the elimination of points.
    """

    point_inverse: FloatArray
    matrix: sparse.csr_array
    right: FloatArray
    before: FloatArray


def reduced_system(observations: JointObservations, weight: FloatArray) -> ReducedSystem:
    """Assemble (6) with the weights (n,) given, 1 / px^2."""
    inverse = _point_inverse(observations, weight)
    cleaned = off_points(observations, weight, inverse, observations.residuals_px)
    layout = observations.layout
    right, before = np.zeros(layout.num_columns + 1), np.zeros(layout.num_columns + 1)
    blocks = _Blocks(layout.num_columns)
    for image in np.flatnonzero(layout.has_columns).tolist():
        rows = observations.rows(image)
        own, columns = observations.nuisance[rows], layout.columns[image]
        weighted = own * weight[rows, None, None]
        gram = weighted.reshape(-1, layout.width).T @ own.reshape(-1, layout.width)
        np.add.at(right, columns, np.einsum("nac,na->c", weighted, cleaned[rows]))
        np.add.at(before, columns, gram.diagonal())
        blocks.add(columns, columns[None], gram[None])
        if observations.points_independent or rows.start == rows.stop:
            continue
        points, track = np.unique(observations.point_idx[rows], return_inverse=True)
        around = neighbourhood(observations, points)
        crossed = np.einsum("nac,nai->nic", weighted, observations.point_jacobian[rows])
        eliminated = inverse[points] @ sum_by_track(crossed, track, points.size)  # V^-1 W^T
        slab = around.gather(around.point_nuisance(weight), eliminated)
        blocks.add(columns, layout.columns[around.images], -slab.transpose(0, 2, 1))
    return ReducedSystem(inverse, blocks.matrix(), right[:-1], before[:-1])


def score_meat(observations: JointObservations, score: FloatArray) -> sparse.csr_array:
    """Return M (D, D): sum over tracks of g_t g_t^T, with g_t the score of the base system from track t.

    Parameters
    ----------
    score : (n, C) w N^T y~, with y~ the residuals after the step; they are off J, so g_t is its sum over the views
    """
    layout = observations.layout
    blocks = _Blocks(layout.num_columns)
    for image in np.flatnonzero(layout.has_columns).tolist():
        rows = observations.rows(image)
        if rows.start == rows.stop:
            continue
        points, track = np.unique(observations.point_idx[rows], return_inverse=True)
        around = neighbourhood(observations, points)
        own = sum_by_track(score[rows], track, points.size)
        slab = around.gather(score[around.views, None, :], own[:, None, :])
        blocks.add(layout.columns[image], layout.columns[around.images], slab.transpose(0, 2, 1))
    return blocks.matrix()


def nuisance_score(observations: JointObservations, weight: FloatArray, left_px: FloatArray) -> FloatArray:
    """Return (n, C): w N^T y~ of every observation."""
    weighted = left_px * weight[:, None]
    out = observations.nuisance[:, 0] * weighted[:, 0, None]
    out += observations.nuisance[:, 1] * weighted[:, 1, None]
    return np.asarray(out)


def off_points(
    observations: JointObservations, weight: FloatArray, point_inverse: FloatArray, values_px: FloatArray
) -> FloatArray:
    """Return values (n, 2) minus what moving the points alone would remove: J V^-1 J^T w."""
    if observations.points_independent:
        return values_px
    jacobian, point_idx = observations.point_jacobian, observations.point_idx
    weighted = values_px * weight[:, None]
    pull = np.empty((observations.num_points, 3))
    for i in range(3):
        along = jacobian[:, 0, i] * weighted[:, 0] + jacobian[:, 1, i] * weighted[:, 1]
        pull[:, i] = np.bincount(point_idx, along, observations.num_points)
    step = np.einsum("pij,pj->pi", point_inverse, pull)[point_idx]
    return np.asarray(values_px - np.einsum("nai,ni->na", jacobian, step))


def _point_inverse(observations: JointObservations, weight: FloatArray) -> FloatArray:
    if observations.points_independent:
        return np.zeros((observations.num_points, 3, 3))
    jacobian = observations.point_jacobian.transpose(1, 2, 0)
    information = point_information(jacobian, weight, observations.point_idx, observations.num_points)
    seen = np.flatnonzero(np.diff(observations.point_offsets) > 0)
    scale = np.sqrt(np.einsum("pii->pi", information[seen]))
    unit = information[seen] / scale[:, :, None] / scale[:, None, :]
    out = np.zeros_like(information)
    out[seen] = np.linalg.inv(unit) / scale[:, :, None] / scale[:, None, :]
    return out


class _Blocks:
    """A sparse symmetric matrix, collected block by block; the column behind the last one is padding."""

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
        if self._pending > 4_000_000:
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
        """The sum of all blocks."""
        self._flush()
        shape = (self._num_columns, self._num_columns)
        return sparse.csr_array(shape) if self._sum is None else self._sum
