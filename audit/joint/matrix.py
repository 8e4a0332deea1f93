"""S and M: sparse symmetric matrices as blocks between pairs of images, where the compiled sums made them."""

from __future__ import annotations

from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from sfm_audit.audit.kernels.joint_matrix import Blocks, checked_blocks, times_blocks
from sfm_audit.loaders.arrays import FloatArray, IntArray


class PairMatrix:
    """A symmetric matrix A + A^T (D, D); of A the blocks between pairs of images.

    Parameters
    ----------
    given : the blocks (m, C, C)
    group : (D,) number of each column; columns of equal number stand in the same blocks
    marks : places within rows and columns of a block that see all its groups
    """

    def __init__(self, given: Blocks, group: IntArray, marks: tuple[int, ...]) -> None:
        self.blocks = checked_blocks(given)
        self.group = group
        self._marks = list(marks)

    @property
    def shape(self) -> tuple[int, int]:
        """(D, D)."""
        return self.blocks.size, self.blocks.size

    def diagonal(self) -> FloatArray:
        """(D,)."""
        size, rows, columns, blocks = self.blocks
        first, second = rows[:, self._marks, None], columns[:, None, self._marks]
        own = (first == second).any(axis=(1, 2))
        rows, columns, blocks = rows[own], columns[own], blocks[own]
        meet = rows[:, :, None] == columns[:, None, :]
        at = np.broadcast_to(rows[:, :, None], blocks.shape)[meet]
        return np.asarray(2.0 * np.bincount(at, blocks[meet], size + 1)[:size])

    def __matmul__(self, values: FloatArray) -> FloatArray:
        """Return the product with (D, c)."""
        found = times_blocks(self.blocks, values)
        return np.asarray(self.csr @ values) if found is None else found

    def toarray(self) -> FloatArray:
        """(D, D)."""
        return np.asarray(self.csr.toarray())

    @cached_property
    def csr(self) -> sparse.csr_array:
        """The same for scipy: where there are no kernels any more."""
        size, rows, columns, blocks = self.blocks
        row = np.broadcast_to(rows[:, :, None], blocks.shape).ravel()
        column = np.broadcast_to(columns[:, None, :], blocks.shape).ravel()
        half = sparse.coo_array((blocks.ravel(), (row, column)), shape=(size + 1, size + 1)).tocsr()
        return sparse.csr_array((half + half.T)[:size, :size])

    def pattern(self) -> sparse.csr_array:
        """(G, G) 1 where groups of columns couple."""
        size, rows, columns, _ = self.blocks
        num = int(self.group.max(initial=-1)) + 1
        padded = np.append(self.group, num)
        row, column = (padded[each[:, self._marks].clip(max=size)] for each in (rows, columns))
        first = np.repeat(row, len(self._marks), axis=1).ravel()
        second = np.tile(column, len(self._marks)).ravel()
        real = (first < num) & (second < num)
        first, second = first[real], second[real]
        places = np.concatenate([first, second]), np.concatenate([second, first])
        found = sparse.coo_array((np.ones(2 * first.size), places), shape=(num, num)).tocsr()
        found.data[:] = 1.0  # some couple more than once
        return found


Symmetric: TypeAlias = sparse.csr_array | PairMatrix
"""Of the compiled sums, and of numpy's."""


def csr_of(matrix: Symmetric) -> sparse.csr_array:
    """Return any of both for scipy."""
    return matrix.csr if isinstance(matrix, PairMatrix) else matrix


def operator_of(matrix: Symmetric) -> sparse_linalg.LinearOperator:
    """Return what multiplies a vector by any of both."""
    if isinstance(matrix, PairMatrix):
        return sparse_linalg.LinearOperator(
            matrix.shape, matvec=lambda vector: matrix @ vector.reshape(-1, 1), dtype=np.float64
        )
    return sparse_linalg.aslinearoperator(matrix)


def groups_of(matrix: Symmetric) -> tuple[sparse.csr_array, IntArray]:
    """Return which groups of columns couple (G, G), entries 1, and the group of each column (D,)."""
    if isinstance(matrix, PairMatrix):
        return matrix.pattern(), matrix.group
    ones = np.ones(matrix.indices.size)
    return sparse.csr_array((ones, matrix.indices, matrix.indptr), shape=matrix.shape), np.arange(matrix.shape[0])
