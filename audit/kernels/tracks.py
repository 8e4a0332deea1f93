"""Whitening of all tracks of a model, and the likelihood of their variances: tracks.c."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.kernels.library import Bytes, Double, Doubles, Ints, Size, SmallInts, kernel, kernels_in_use
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray, UInt8Array

_LANES = 4
_NUM_COLUMNS = 10


def available() -> bool:
    """Whether the functions of this module can be called."""
    return kernels_in_use()


@dataclass(frozen=True, slots=True, eq=False)
class Whitened:
    """What is written for n observations; see `audit.noise.tracks.TrackStatistics`."""

    whitened_px: FloatArray
    verified: BoolArray
    track_length: Int32Array
    other_sq_px2: FloatArray
    other_dof: Int32Array

    @classmethod
    def of_size(cls, n: int) -> Whitened:
        """Arrays in which nothing is written yet."""
        lengths, dof = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
        return cls(np.empty((2, n)), np.empty(n, dtype=np.bool_), lengths, np.empty(n), dof)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points and their tracks.

    columns: (P, 10) information xx, xy, xz, yy, yz, zz, after ``invert`` its inverse; gradient, then the point's step
    to its optimum; number of observations.        rank: (P,) of the information, once inverted.
    """

    columns: FloatArray
    rank: UInt8Array

    def invert(self, least_determinant: float) -> IntArray:
        """Invert; return the points that are left, whose determinant with unit diagonal is not above the least."""
        run = kernel("track_inverses", Size, Double, Doubles, Bytes)
        if run is None or not run(len(self.rank), least_determinant, self.columns, self.rank):
            return np.empty(0, dtype=np.int64)
        return np.flatnonzero(self.rank == np.iinfo(np.uint8).max)

    def whiten(
        self,
        observations: tuple[FloatArray, FloatArray, IntArray],
        used: BoolArray,
        limits: tuple[int, float],
        out: Whitened,
    ) -> tuple[float, float]:
        """Write what is known of the used observations; return what the points' steps remove, and the sum of squares.

        observations : as `sums` got them        limits : min_track_length, min_eigenvalue
        """
        residuals_px, point_jacobian, point_idx = observations
        n, mask, verified = point_idx.size, used.view(np.uint8), out.verified.view(np.uint8)
        track_sq, removed = np.zeros(len(self.rank)), np.zeros(2)
        of_rows = (Size, Doubles, Doubles, Ints, Bytes)
        whiten = kernel("track_whiten", *of_rows, Doubles, Double, Double, Doubles, Bytes, Doubles, Doubles)
        others = kernel(
            "track_others", Size, Ints, Bytes, Doubles, Bytes, Doubles, Doubles, Bytes, Doubles, SmallInts, SmallInts
        )
        if whiten is not None and others is not None:
            rows = (n, residuals_px, point_jacobian, point_idx, mask)
            whiten(*rows, self.columns, *map(float, limits), out.whitened_px, verified, track_sq, removed)
            tracks = (self.columns, self.rank, track_sq)
            own = (out.other_sq_px2, out.other_dof, out.track_length)
            others(n, point_idx, mask, *tracks, out.whitened_px, verified, *own)
        return float(removed[0]), float(removed[1])


def sums(
    residuals_px: FloatArray, point_jacobian: FloatArray, point_idx: IntArray, used: BoolArray, num_points: int
) -> Points:
    """Add up information and gradient of each point over the observations that are used.

    Parameters
    ----------
    residuals_px : (2, n)        point_jacobian : (2, 3, n)        point_idx : (n,)        used : (n,)
    """
    n = point_idx.size
    if residuals_px.shape != (2, n) or point_jacobian.shape != (2, 3, n) or used.shape != (n,):
        raise ValueError("residuals, Jacobians, points and mask are not of one size")
    if n and not (point_idx.min() >= 0 and point_idx.max() < num_points):
        raise IndexError(f"observations of points beyond the {num_points} there are")
    points = Points(np.zeros((num_points, _NUM_COLUMNS)), np.empty(num_points, dtype=np.uint8))
    run = kernel("track_sums", Size, Doubles, Doubles, Ints, Bytes, Doubles)
    if run is not None:
        run(n, residuals_px, point_jacobian, point_idx, used.view(np.uint8), points.columns)
    return points


@dataclass(frozen=True, slots=True, eq=False)
class PriorGroups:
    """Observations of equal degrees of freedom beside each other, for `sums`.

    dof: (g,) of each group, ascending.        counts: (g,) observations.        starts: (g + 1,) rows in memory.
    sq_px2, other_sq_px2: q and c of `audit.noise.prior.fit_track_prior`; filled up with 0 and
    2^1000.
    """

    dof: FloatArray
    counts: IntArray
    starts: IntArray
    sq_px2: FloatArray
    other_sq_px2: FloatArray

    @classmethod
    def of(
        cls, e: FloatArray, other_sq_px2: FloatArray, other_dof: Int32Array | IntArray, used: BoolArray | None = None
    ) -> PriorGroups | None:
        """Group observations by their degrees of freedom; None where the kernels are not to be used.

        Parameters
        ----------
        e : (2, n) whitened residuals, px, or (n,) squares of their lengths
        used : (n,) which of them; all when None
        """
        count = kernel("prior_counts", Size, Bytes, SmallInts, Size, Ints)
        run = kernel("prior_groups", Size, Bytes, Doubles, Size, Doubles, SmallInts, Ints, Doubles, Doubles)
        if count is None or run is None:
            return None
        n, mask = other_dof.size, np.ones(other_dof.size, dtype=np.bool_) if used is None else used
        if e.shape not in {(n,), (2, n)} or other_sq_px2.shape != (n,) or mask.shape != (n,):
            raise ValueError("residuals, sums of squares, degrees of freedom and mask are not of one size")
        dof = np.ascontiguousarray(other_dof, dtype=np.int32)
        of_dof = np.zeros(max(int(dof.max(initial=0)), 0) + 1, dtype=np.int64)
        if count(n, mask.view(np.uint8), dof, of_dof.size, of_dof):
            raise ValueError("degrees of freedom are negative")
        rows = np.concatenate([[0], np.cumsum(-(-of_dof // _LANES) * _LANES)])
        sq, other = np.zeros(rows[-1]), np.full(rows[-1], 2.0**1000)
        given = np.ascontiguousarray(e), int(e.ndim == 1), np.ascontiguousarray(other_sq_px2), dof
        run(n, mask.view(np.uint8), *given, rows[:-1].copy(), sq, other)
        there = np.flatnonzero(of_dof)
        return cls(there.astype(np.float64), of_dof[there], np.append(rows[there], rows[-1]), sq, other)

    def sums(self, prior_sq: float) -> FloatArray:
        """Return sums (g, 6) of ln(b / (b + q)), ln(b + q), 1 / b, 1 / (b + q) and their squares with b = prior_sq + c.

        prior_sq and all sums of squares within 1e-140 .. 1e140.
        """
        out = np.empty((len(self.dof), 6))
        run = kernel("prior_sums", Size, Ints, Ints, Doubles, Doubles, Double, Doubles)
        if run is not None:
            run(len(self.dof), self.starts, self.counts, self.sq_px2, self.other_sq_px2, prior_sq, out)
        return out
