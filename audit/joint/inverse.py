"""S^+ without an eigendecomposition: gauge and other null directions deflated, one Cholesky factor (method.md 11)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Protocol

import numpy as np

from sfm_audit.audit.joint.band import Band, band_of, dense_of
from sfm_audit.audit.joint.banded import BandedFactor, banded_factor
from sfm_audit.audit.joint.banded_inverse import banded_inverse
from sfm_audit.audit.joint.lapack import cholesky_in_place, inverse_of_factor, mirror, solve_by_factor
from sfm_audit.audit.joint.matrix import Symmetric
from sfm_audit.audit.kernels.joint_parts import dense_entries
from sfm_audit.audit.kernels.joint_scores import BandArrays
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

NULL_EIGENVALUE: Final = 1e-11  # of S with unit diagonal
_DEAD: Final = 1e-12  # share of B's diagonal that the elimination of points leaves: below it, rounding
_GAUGE_EIGENVALUE: Final = 1e-8  # a claimed direction of the gauge that costs more is none
_SHIFT: Final = 1e-12
_MAX_NULL: Final = 512
_TINY: Final = 250  # columns up to which an inverse costs less than looking for null directions
_SMALL: Final = 2000  # columns of a dense factor that is kept beside its inverse
_INVERSE_ITERATIONS: Final = 6
_ROUNDING: Final = 512 * np.finfo(np.float64).eps  # of sums over some thousand observations; measured: 40 to 250
_IN_NULL: Final = 1e-6  # squared length of a parameter in null directions from which on it is not identified


class SymmetricInverse(Protocol):
    """S^+ (D, D), however it is held."""

    def __len__(self) -> int:
        """D."""
        ...

    def apply(self, right: FloatArray) -> FloatArray:
        """S^+ right, of (D,) or (D, c)."""
        ...

    def times(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """S^+ (all rows, at some columns) @ right: (D, c) of (k, c)."""
        ...

    def within(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """The entries of S^+ at some columns @ right: (k, c) of (k, c)."""
        ...

    def rows(self, columns: IntArray) -> FloatArray:
        """(k, D) rows of S^+."""
        ...

    def block(self, columns: IntArray) -> FloatArray:
        """(k, k) entries of S^+ at some columns."""
        ...

    def blocks(self, columns: IntArray) -> FloatArray:
        """(B, k, k) entries of S^+ at columns (B, k)."""
        ...

    def arrays(self) -> FloatArray | BandArrays:
        """As compiled sums take it."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DenseInverse:
    """S^+ as an array (D, D)."""

    array: FloatArray

    def __len__(self) -> int:
        return len(self.array)

    def apply(self, right: FloatArray) -> FloatArray:
        """S^+ right, of (D,) or (D, c)."""
        return np.asarray(self.array @ right)

    def times(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """S^+ (all rows, at some columns) @ right: (D, c) of (k, c)."""
        main = self.array if columns.size == len(self.array) else self.array[columns].T
        return np.asarray(main @ right)

    def within(self, columns: IntArray, right: FloatArray) -> FloatArray:
        """The entries of S^+ at some columns @ right: (k, c) of (k, c)."""
        return np.asarray(self.block(columns) @ right)

    def blocks(self, columns: IntArray) -> FloatArray:
        """(B, k, k) entries of S^+ at columns (B, k)."""
        return self.array[columns[:, :, None], columns[:, None, :]]

    def arrays(self) -> FloatArray:
        """S^+ (D, D) in C order, as compiled sums take it; symmetric."""
        return self.array if self.array.flags.c_contiguous else np.ascontiguousarray(self.array.T)

    def rows(self, columns: IntArray) -> FloatArray:
        """(k, D) rows of S^+."""
        return self.array[columns]

    def block(self, columns: IntArray) -> FloatArray:
        """(k, k) entries of S^+ at some columns."""
        compiled = dense_entries(self.array, columns)
        return self.array[np.ix_(columns, columns)] if compiled is None else compiled


@dataclass(frozen=True, slots=True, eq=False)
class JointInverse:
    """S^+ of the base system and, behind its D columns, of what was included since.

    main: of the base system alone; inclusion adds update update^T to it.
    update: (D, k).    border: (D, m).    corner: (m, m).
    unidentified: (D,) parameters without effect, or with a share in a null direction that is no gauge.
    num_null: further null directions found.
    free: (D, g) directions of the gauge, in the units of the columns.
    """

    main: SymmetricInverse
    update: FloatArray
    border: FloatArray
    corner: FloatArray
    unidentified: BoolArray
    num_null: int
    free: FloatArray

    @property
    def size(self) -> int:
        """D + m."""
        return len(self.main) + len(self.corner)

    def within(self, support: IntArray, right: FloatArray) -> FloatArray:
        """Return (s, c): the entries at some sorted rows and the same columns, times right (s, c)."""
        if support.size == self.size:
            return self.times(support, right)
        base, extra = self._split(support)
        head, tail = right[: base.size], right[base.size :]
        update = self.update[base]
        border = self.border[np.ix_(base, extra)]
        above = self.main.within(base, head) + update @ (update.T @ head) + border @ tail
        return np.vstack([above, border.T @ head + self.corner[np.ix_(extra, extra)] @ tail])

    def _split(self, support: IntArray) -> tuple[IntArray, IntArray]:
        d = len(self.main)
        k = int(np.searchsorted(support, d))
        return support[:k], support[k:] - d

    def times(self, support: IntArray, right: FloatArray) -> FloatArray:
        """Return S^+ (all rows, at some sorted columns) @ right: (D + m, c) of (s, c)."""
        base, extra = self._split(support)
        head, tail = right[: base.size], right[base.size :]
        above = self.main.times(base, head) + self.update @ (self.update[base].T @ head) + self.border[:, extra] @ tail
        below = self.border[base].T @ head + self.corner[:, extra] @ tail
        return np.vstack([above, below])

    def bordered(self, solution: FloatArray, schur_root: FloatArray) -> JointInverse:
        """Return the inverse with n columns more.

        Parameters
        ----------
        solution : (D + m, n) B = S^+ R of the new columns        schur_root : (n, r), K^+ = root root^T

        Notes
        -----
        [[S^+ + B K^+ B^T, -B K^+], [-K^+ B^T, K^+]].
        """
        d = len(self.main)
        moved = solution @ schur_root
        head, tail = moved[:d], moved[d:]
        border = np.hstack([self.border + head @ tail.T, -head @ schur_root.T])
        cross = -tail @ schur_root.T
        corner = np.block([[self.corner + tail @ tail.T, cross], [cross.T, schur_root @ schur_root.T]])
        return replace(self, update=np.hstack([self.update, head]), border=border, corner=corner)


def joint_inverse(matrix: Symmetric, before: FloatArray, gauge: FloatArray) -> JointInverse:
    """Invert S (D, D) off its null directions.

    Parameters
    ----------
    before : (D,) diagonal of B        gauge : (D, g) directions that should be free

    Notes
    -----
    In units in which S has unit diagonal: with G an orthonormal basis of the gauge, S + G G^T has S's other
    eigenvectors and 1 on G, and its inverse minus G G^T is S^+. Null directions that are no gauge are looked for by
    inverse iteration with the factor, and deflated in the same way.
    """
    size = matrix.shape[0]
    nothing = np.zeros((size, 0))
    if not size:
        empty = np.zeros((0, 0))
        return JointInverse(DenseInverse(empty), nothing, nothing, empty, np.zeros(0, dtype=bool), 0, nothing)
    factor, main, inverse_scale, free, further = _deflated(matrix, before, gauge, with_inverse=True)
    lost = (inverse_scale == 0) | ((further**2).sum(axis=1) > _IN_NULL)
    if main is None:
        main = _inverse(factor, np.hstack([free, further]), inverse_scale, in_place=True)[0]
    unscaled = free * inverse_scale[:, None]
    return JointInverse(main, nothing, nothing, np.zeros((0, 0)), lost, further.shape[1], unscaled)


def joint_solution(matrix: Symmetric, before: FloatArray, gauge: FloatArray, right: FloatArray) -> FloatArray:
    """Return S^+ right (D,) as `joint_inverse` would have it."""
    if not len(right):
        return right
    factor, _, inverse_scale, _, further = _deflated(matrix, before, gauge, with_inverse=len(right) <= _TINY)
    step = factor.solve((right * inverse_scale)[:, None])[:, 0]
    step -= further @ (further.T @ step)  # the last ones that were found are not in the factor where there are too many
    return np.asarray(step * inverse_scale)


class _Deflated(NamedTuple):
    """The factor in units of unit diagonal.

    inverse: S^+, where it was asked for and made on the way.    inverse_scale: (D,) 1 / unit, 0 of dead columns.
    free, further: (D, g) directions of the gauge, (D, k) others found.
    """

    factor: BandedFactor | _DenseFactor
    inverse: SymmetricInverse | None
    inverse_scale: FloatArray
    free: FloatArray
    further: FloatArray


def _deflated(matrix: Symmetric, before: FloatArray, gauge: FloatArray, *, with_inverse: bool) -> _Deflated:
    """Deflate the gauge, and further null directions as long as there are some."""
    diagonal = matrix.diagonal()
    dead = diagonal <= _DEAD * before
    scale = np.where(dead, 1.0, np.sqrt(np.where(dead, 1.0, diagonal)))
    free = _orthonormal(gauge, scale, dead, matrix)
    rounding = np.where(dead, 0.0, np.sqrt(np.where(dead, 1.0, before)) / scale)
    inverse_scale = np.where(dead, 0.0, 1.0 / scale)
    band = band_of(matrix)
    deflated, further = free, free[:, :0]
    inverse: SymmetricInverse | None = None
    while True:
        factor = _factor(matrix, inverse_scale, deflated, band)
        if with_inverse and factor.shift == 0.0 and (isinstance(factor, BandedFactor) or len(before) <= _SMALL):
            inverse, trace = _inverse(factor, deflated, inverse_scale)
            if _cannot_be_null(trace, rounding):
                break
        found = _null_directions(factor, rounding)
        if not found.shape[1]:
            break
        inverse = None
        further = np.hstack([further, found])
        deflated = np.hstack([deflated, found])
        if further.shape[1] >= _MAX_NULL:
            break
    return _Deflated(factor, inverse, inverse_scale, free, further)


def _cannot_be_null(trace: float, rounding: FloatArray) -> bool:
    """Whether no direction can be what `_null_directions` looks for.

    No eigenvalue of the inverse is above its trace, none of S thus below its reciprocal; and (sum |v| rounding)^2 is at
    most the sum of the squares of ``rounding``. Twice as far as that, for what both are wrong by themselves.
    """
    unsure = _ROUNDING * float(rounding @ rounding)
    return bool(0.0 < 2.0 * trace * (NULL_EIGENVALUE + unsure) < 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _DenseFactor:
    """Lower Cholesky factor (D, D) of S + Z Z^T + shift I, unit diagonal of S."""

    array: FloatArray
    deflated: FloatArray
    shift: float

    def solve(self, right: FloatArray) -> FloatArray:
        """(D, c), off Z."""
        out = solve_by_factor(self.array, right)
        return np.asarray(out - self.deflated @ (self.deflated.T @ out))


def _dense(matrix: Symmetric, inverse_scale: FloatArray, deflated: FloatArray) -> FloatArray:
    """S with unit diagonal, of dead columns nothing but that, plus Z Z^T; in Fortran order, for LAPACK."""
    out = dense_of(matrix, inverse_scale).T  # symmetric: the transpose is in Fortran order
    np.einsum("ii->i", out)[...] += inverse_scale == 0
    if deflated.shape[1]:
        _add_outer(out, deflated, 1.0)
    return out


def _add_outer(out: FloatArray, columns: FloatArray, sign: float) -> None:
    """Add sign Z Z^T in place, some columns at a time."""
    for start in range(0, len(out), 1024):
        part = slice(start, start + 1024)
        out[:, part] += sign * (columns @ columns[part].T)


def _factor(
    matrix: Symmetric, inverse_scale: FloatArray, deflated: FloatArray, band: Band | None
) -> BandedFactor | _DenseFactor:
    banded = banded_factor(matrix, band, deflated, inverse_scale) if band else None
    return banded or _dense_factor(matrix, inverse_scale, deflated)


def _dense_factor(matrix: Symmetric, inverse_scale: FloatArray, deflated: FloatArray) -> _DenseFactor:
    shift = 0.0
    while True:
        array = _dense(matrix, inverse_scale, deflated)
        if shift:
            array[np.diag_indices(len(array))] += shift
        if cholesky_in_place(array):
            return _DenseFactor(array, deflated, shift)
        shift = max(_SHIFT, 10.0 * shift)


def _orthonormal(gauge: FloatArray, scale: FloatArray, dead: BoolArray, matrix: Symmetric) -> FloatArray:
    """(D, g') orthonormal basis, in scaled units, of those directions of the gauge that S leaves free."""
    if not gauge.shape[1]:
        return gauge
    columns = gauge * scale[:, None]
    columns[dead] = 0.0
    columns = columns / np.maximum(np.sqrt((columns**2).sum(axis=0)), 1e-300)
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    left = left[:, singular > 1e-9 * singular.max(initial=0.0)]
    cost = left.T @ ((matrix @ (left / scale[:, None])) / scale[:, None])
    values, vectors = np.linalg.eigh(0.5 * (cost + cost.T))
    return np.asarray(left @ vectors[:, values < _GAUGE_EIGENVALUE])


def _null_directions(factor: BandedFactor | _DenseFactor, rounding: FloatArray) -> FloatArray:
    """(D, k) orthonormal directions with an eigenvalue below the threshold, by block inverse iteration.

    ``rounding`` (D,): root of the diagonal of B over that of S. What is left of B has rounding in its digits: along a
    direction v these add up to some eps (sum |v| rounding)^2, and an eigenvalue below that says nothing.
    """
    rng, size = np.random.default_rng(0), len(rounding)
    count = min(8, size)
    while True:
        block = np.linalg.qr(rng.normal(size=(size, count)))[0]
        for _ in range(_INVERSE_ITERATIONS):
            block = np.linalg.qr(factor.solve(block))[0]
        values, vectors = np.linalg.eigh(block.T @ factor.solve(block))
        directions = block @ vectors
        unsure = _ROUNDING * (np.abs(directions).T @ rounding) ** 2
        null = 1.0 / np.maximum(values, 1e-300) - factor.shift < NULL_EIGENVALUE + unsure
        if not null.all() or count >= min(size, _MAX_NULL):
            return np.asarray(directions[:, null])
        count = min(size, 4 * count)


def _inverse(
    factor: BandedFactor | _DenseFactor, deflated: FloatArray, inverse_scale: FloatArray, *, in_place: bool = False
) -> tuple[SymmetricInverse, float]:
    """From the factor of the scaled, deflated matrix to S^+, and its trace in units of unit diagonal.

    Parameters
    ----------
    deflated : (D, g) that is in the factor, or more        in_place : whether a dense factor's memory may be used
    """
    if isinstance(factor, BandedFactor):
        banded = banded_inverse(factor, inverse_scale)
        return banded, banded.trace
    inverse = inverse_of_factor(factor.array, in_place=in_place)
    mirror(inverse)
    if deflated.shape[1]:
        _add_outer(inverse, deflated, -1.0)
    trace = float(np.trace(inverse))
    inverse *= inverse_scale[:, None]
    inverse *= inverse_scale
    return DenseInverse(inverse.T), trace
