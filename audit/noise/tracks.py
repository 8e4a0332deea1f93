"""Residuals of a reconstruction are shrunk by their own points: undo it (method.md sections 3a and 3b, (2) and (3)).

Everything works on all observations of a model at once; ``point_idx`` ties an observation to its track.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm_audit.audit.kernels import tracks as compiled
from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.noise.others import EVERY, ByRow, ByTrack, Others, TrackTable
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, Int32Array, IntArray

_SUFFICIENT_DETERMINANT = 1e-6  # of the information matrix with unit diagonal: closed-form inverse, else eigenvectors
_RANK_THRESHOLD = 1e-10  # eigenvalues of that matrix, relative to the largest: singular values of J below 1e-5
_CHUNK = 1 << 14  # observations per pass: the temporaries stay in the processor's cache
_SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True, eq=False)
class TrackStatistics:
    """What the tracks say about each of n observations.

    whitened_px: (2, n) e of (2), covariance sigma^2 I under a correct model; NaN where not verified.
    verified: (n,) L >= min_track_length, the smaller eigenvalue of I - H >= min_eigenvalue, J finite (it is not at the
    poles of a panorama and on the rim of a division model; such an observation does not move its point either).
    others: what the other observations of the tracks say.
    removable_sq_px2, total_sq_px2: what moving the points alone would remove of the sum of squared residuals.
    """

    whitened_px: FloatArray
    verified: BoolArray
    others: Others
    removable_sq_px2: float
    total_sq_px2: float

    @property
    def track_length(self) -> Int32Array:
        """(n,) L, audited observations of the track."""
        return self.others.lengths(EVERY)

    @property
    def other_sq_px2(self) -> FloatArray:
        """(n,) nu_k a_k^2 of (3): the track's sum of squares without observation k, floored at 0, px^2."""
        return self.others.of(EVERY)[0]

    @property
    def other_dof(self) -> Int32Array:
        """(n,) nu_k = 2 L - 2 - rank."""
        return self.others.dof(EVERY)


def track_statistics(
    residuals_px: FloatArray,
    point_jacobian: FloatArray,
    point_idx: IndexArray,
    num_points: int,
    *,
    min_track_length: int = 3,
    min_eigenvalue: float = 0.05,
    left_out: BoolArray | None = None,
) -> TrackStatistics:
    r"""Whiten residuals whose 3D points were triangulated from them, and take each track's sum of squares without it.

    Parameters
    ----------
    residuals_px : (2, n)         observed minus projected, px
    point_jacobian : (2, 3, n)    d projection / d point, px per model unit
    point_idx : (n,)              row of the 3D point of each observation
    left_out : (n,)               observations that the tracks of the others do without; their own values are those of
                                  the full tracks, and the model's sums of squares do without them

    Notes
    -----
    With A = sum J^T J over a track: cov(eps_k) = sigma^2 (I - H_k), H_k = J_k A^-1 J_k^T,
    e_k = (I - H_k)^(-1/2) eps_k (2). Columns of J are scaled per track; a singular A is replaced by its
    pseudo-inverse and the rank lowers the degrees of freedom. Residuals are first projected off the column space of
    their track: points are not always at their optimum. |e_k|^2 is exactly what k adds to the track's sum of squares,
    so the sum without k is SS - |e_k|^2 (3).

    Cameras are treated as exact: their share of the leverage is 8 / 2n of an image, and is left in.
    """
    limits = (min_track_length, min_eigenvalue)
    some_left_out = left_out is not None and left_out.any()
    if compiled.available():
        return _compiled(
            (residuals_px, point_jacobian, point_idx), num_points, limits, left_out if some_left_out else None
        )
    full = _statistics(residuals_px, point_jacobian, point_idx, num_points, limits)
    if left_out is None or not some_left_out:
        return full
    kept = ~left_out
    rows = residuals_px[:, kept], point_jacobian[:, :, kept], point_idx[kept]
    return _replace_rows(full, kept, _statistics(*rows, num_points, limits))


def _compiled(
    observations: tuple[FloatArray, FloatArray, IndexArray],
    num_points: int,
    limits: tuple[int, float],
    left_out: BoolArray | None,
) -> TrackStatistics:
    """`track_statistics` by the compiled kernels; tracks of which a point is not well determined are inverted here."""
    residuals_px, point_jacobian = (np.ascontiguousarray(array) for array in observations[:2])
    n = observations[2].size
    point_idx = small_ints(observations[2], n)
    out = np.empty((2, n)), np.ones(n, dtype=np.bool_)
    used = [out[1], *([] if left_out is None else [~left_out])]  # all: what is verified is written where it was read
    removable = total = 0.0
    tables: list[TrackTable] = []
    for rows in used:  # the second writes over what the first said of them
        points = compiled.sums(residuals_px, point_jacobian, point_idx, rows, num_points)
        singular = points.invert(_SUFFICIENT_DETERMINANT)
        if singular.size:
            inverse, rank = _inverses(points.columns[singular, :6].T)
            points.columns[singular, 6:9] = symmetric_times(inverse, points.columns[singular, 6:9].T).T
            points.columns[singular, :6], points.rank[singular] = inverse.T, rank
        track_sq, removable, total = points.whiten((residuals_px, point_jacobian, point_idx), rows, limits, out)
        length = points.num_observations
        tables.insert(0, TrackTable(track_sq, 2 * length - 2 - points.rank, length))
    return TrackStatistics(*out, ByTrack(point_idx, *out, tuple(tables), left_out), removable, total)


def _replace_rows(full: TrackStatistics, rows: BoolArray, part: TrackStatistics) -> TrackStatistics:
    """Return the statistics of ``part`` in ``rows``, of ``full`` elsewhere; the model's sums of squares of ``part``."""
    full.whitened_px[:, rows], full.verified[rows] = part.whitened_px, part.verified
    others = ByRow(full.other_sq_px2, full.other_dof, full.track_length)
    others.sq_px2[rows], others.all_dof[rows] = part.other_sq_px2, part.other_dof
    others.track_length[rows] = part.track_length
    return replace(full, others=others, removable_sq_px2=part.removable_sq_px2, total_sq_px2=part.total_sq_px2)


def _statistics(
    residuals_px: FloatArray,
    point_jacobian: FloatArray,
    point_idx: IndexArray,
    num_points: int,
    limits: tuple[int, float],
) -> TrackStatistics:
    """`track_statistics` of all observations, by numpy; limits: min_track_length, min_eigenvalue."""
    min_track_length, min_eigenvalue = limits
    differentiable = _finite_columns(point_jacobian)
    if not differentiable.all():
        point_jacobian = np.where(differentiable, point_jacobian, 0.0)
    length = np.bincount(point_idx, minlength=num_points).astype(np.int32)
    inverse, rank = inverse_information(point_jacobian, point_idx, num_points)
    verified = differentiable
    for part in _chunks(verified.size):
        verified[part] &= length.take(point_idx[part]) >= min_track_length
    whitened, square, removable = _whiten(residuals_px, point_jacobian, point_idx, inverse, (verified, min_eigenvalue))
    del inverse  # the largest array that is not kept
    track_sq = sum_by_point(square, point_idx, num_points)
    other_sq = square
    for part in _chunks(len(square)):
        own_sq = _squared_lengths(whitened[:, part])
        np.subtract(track_sq.take(point_idx[part]), own_sq, out=other_sq[part])  # (3); NaN where not verified
        np.maximum(other_sq[part], 0.0, out=other_sq[part])
    return TrackStatistics(
        whitened,
        verified,
        ByRow(other_sq, (2 * length - 2 - rank).take(point_idx), length.take(point_idx)),
        removable,
        sum(float(np.vdot(residuals_px[:, part], residuals_px[:, part])) for part in _chunks(len(square))),
    )


def _squared_lengths(vectors: FloatArray) -> FloatArray:
    """Squared lengths (n,) of vectors (2, n)."""
    x, y = vectors
    return np.asarray(x * x + y * y)


def _finite_columns(point_jacobian: FloatArray) -> BoolArray:
    finite = np.empty(point_jacobian.shape[2], dtype=bool)
    for part in _chunks(finite.size):
        np.isfinite(point_jacobian[:, :, part]).all(axis=(0, 1), out=finite[part])
    return finite


def _whiten(
    residuals_px: FloatArray,
    point_jacobian: FloatArray,
    point_idx: IndexArray,
    inverse: FloatArray,
    limits: tuple[BoolArray, float],
) -> tuple[FloatArray, FloatArray, float]:
    """Whiten residuals (2, n), NaN where not verified; a piece at a time, so that only what is kept is of that size.

    Parameters
    ----------
    limits : verified (n,), which is cleared where an eigenvalue of I - H is below the second

    Returns
    -------
    tuple
        (2, n) e; (n,) squared residuals off their tracks' column spaces; the sum of squares that this removes.
    """
    verified, min_eigenvalue = limits
    gradient, square = np.empty_like(inverse[:3]), np.empty(point_idx.size)
    followed = _followed(point_idx)
    for axis in range(3):
        _sum_of_two_products(point_jacobian[:, axis], residuals_px, square)
        gradient[axis] = sum_by_point(square, followed, inverse.shape[1])
    del followed
    step = gradient  # A^+ J^T eps: where the points would move
    for part in _chunks(inverse.shape[1]):
        step[:, part] = symmetric_times(inverse[:, part], gradient[:, part])
    whitened = np.empty_like(residuals_px)
    removable = 0.0
    for part in _chunks(point_idx.size):
        idx, jacobian = point_idx[part], point_jacobian[:, :, part]
        move = step.take(idx, axis=1)
        removed = np.stack([_dot(jacobian[row], move) for row in range(2)])
        removable += float(removed[0] @ removed[0]) + float(removed[1] @ removed[1])
        projected = residuals_px[:, part] - removed
        square[part] = _squared_lengths(projected)
        smallest, x, y = _inverse_root_times(_complement(jacobian, inverse.take(idx, axis=1)), projected)
        good = verified[part]
        good &= smallest >= min_eigenvalue
        whitened[0, part], whitened[1, part] = np.where(good, x, np.nan), np.where(good, y, np.nan)
    return whitened, square, removable


def _complement(jacobian: FloatArray, inverse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """I - H, (m,) each xx, xy, yy, of observations with (2, 3, m) and their points' inverse information (6, m)."""
    by_x, by_y = symmetric_times(inverse, jacobian[0]), symmetric_times(inverse, jacobian[1])
    return 1.0 - _dot(jacobian[0], by_x), -_dot(jacobian[1], by_x), 1.0 - _dot(jacobian[1], by_y)


def _sum_of_two_products(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write a[0] b[0] + a[1] b[1] of (2, n) arrays into out (n,), a piece at a time."""
    for part in _chunks(out.size):
        np.multiply(a[0, part], b[0, part], out=out[part])
        out[part] += a[1, part] * b[1, part]


def _chunks(n: int) -> list[slice]:
    return [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]


def sum_by_point(values: FloatArray, point_idx: IndexArray, num_points: int) -> FloatArray:
    """Sum values (n,) of observations by their track: (P,)."""
    return np.bincount(point_idx, weights=values, minlength=num_points).astype(np.float64, copy=False)


def _followed(point_idx: IndexArray) -> IntArray:
    """Rows as wide as numpy follows them, made once for several sums."""
    return point_idx.astype(np.int64, copy=False)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Dot products of columns: (3, n), (3, n) -> (n,)."""
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return np.asarray(out, dtype=np.float64)


def symmetric_times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Multiply symmetric 3x3 matrices (6, n) in the order of _SYMMETRIC times vectors (3, n)."""
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = vector
    out = np.empty((3, vector.shape[1]))
    out[0] = xx * x + xy * y + xz * z
    out[1] = xy * x + yy * y + yz * z
    out[2] = xz * x + yz * y + zz * z
    return out


def inverse_information(
    point_jacobian: FloatArray, point_idx: IndexArray, num_points: int
) -> tuple[FloatArray, Int32Array]:
    """Return the (pseudo-)inverse (6, P) of each track's information A = sum J^T J, and its rank (P,)."""
    information = np.empty((6, num_points))
    product, followed = np.empty(point_idx.size), _followed(point_idx)
    for row, (i, j) in enumerate(_SYMMETRIC):
        _sum_of_two_products(point_jacobian[:, i], point_jacobian[:, j], product)
        information[row] = sum_by_point(product, followed, num_points)
    del product, followed
    rank = np.empty(num_points, dtype=np.int32)
    for part in _chunks(num_points):
        information[:, part], rank[part] = _inverses(information[:, part])
    return information, rank


def _inverses(information: FloatArray) -> tuple[FloatArray, Int32Array]:
    """(Pseudo-)inverses (6, P) of symmetric 3x3 matrices (6, P), and their ranks (P,)."""
    scale = np.sqrt(information[[0, 3, 5]])
    scale[scale == 0] = 1.0
    xx, xy, xz, yy, yz, zz = (information[row] / (scale[i] * scale[j]) for row, (i, j) in enumerate(_SYMMETRIC))
    cofactor = np.stack(
        [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ]
    )
    determinant = xx * cofactor[0] + xy * cofactor[1] + xz * cofactor[2]
    regular = determinant > _SUFFICIENT_DETERMINANT
    inverse = cofactor / np.where(regular, determinant, 1.0)
    rank = np.full(regular.shape, 3, dtype=np.int32)
    singular = np.flatnonzero(~regular)
    if singular.size:
        full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[:, :, singular].transpose(2, 0, 1)
        values, vectors = np.linalg.eigh(full)
        kept = values > _RANK_THRESHOLD * values[:, -1:]
        rank[singular] = kept.sum(axis=1)
        weights = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
        pseudo = np.einsum("pij,pj,pkj->ikp", vectors, weights, vectors)
        inverse[:, singular] = np.stack([pseudo[i, j] for i, j in _SYMMETRIC])
    for row, (i, j) in enumerate(_SYMMETRIC):
        inverse[row] /= scale[i] * scale[j]
    return inverse, rank


def _inverse_root_times(
    matrix: tuple[FloatArray, FloatArray, FloatArray], vector: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Smaller eigenvalue of symmetric 2x2 matrices, and their inverse symmetric root times vectors (2, n).

    matrix : xx, xy, yy (n,) each

    The root of M is (M + sqrt(det) I) / sqrt(trace + 2 sqrt(det)); where M is not positive definite the result is
    meaningless and the eigenvalue says so.
    """
    xx, xy, yy = matrix
    half_trace = 0.5 * (xx + yy)
    smallest = half_trace - np.hypot(0.5 * (xx - yy), xy)
    with np.errstate(invalid="ignore", divide="ignore"):
        root_det = np.sqrt(xx * yy - xy * xy)
        factor = 1.0 / (root_det * np.sqrt(2.0 * (half_trace + root_det)))  # 1 / (sqrt(det) sqrt(trace + 2 sqrt(det)))
        x = factor * ((yy + root_det) * vector[0] - xy * vector[1])
        y = factor * ((xx + root_det) * vector[1] - xy * vector[0])
    return smallest, x, y
