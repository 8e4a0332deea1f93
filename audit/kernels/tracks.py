"""Whitening of all tracks of a model, and the likelihood of their variances: tracks.c."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.library import Bytes, Double, Doubles, Ints, Size, SmallInts, kernel, kernels_in_use
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, Int32Array, IntArray, UInt8Array

_LANES = 4
_NUM_COLUMNS = 10
_AT_ONCE = 1 << 16  # observations: what is made of them stays in the cache


class Others(Protocol):
    """See `audit.noise.others`."""

    def of(self, rows: slice) -> tuple[FloatArray, Int32Array]:
        """Return sums of squares px^2 and degrees of freedom of the tracks of some observations without these."""

    def dof(self, rows: slice) -> Int32Array:
        """Return the degrees of freedom alone."""


def available() -> bool:
    """Whether the functions of this module can be called."""
    return kernels_in_use()


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points and their tracks.

    columns: (P, 10) information xx, xy, xz, yy, yz, zz, after ``invert`` its inverse; gradient, then the point's step
    to its optimum; number of observations.        rank: (P,) of the information, once inverted.
    """

    columns: FloatArray
    rank: UInt8Array

    @property
    def num_observations(self) -> Int32Array:
        """(P,) of the track."""
        return self.columns[:, _NUM_COLUMNS - 1].astype(np.int32)

    def invert(self, least_determinant: float) -> IntArray:
        """Invert; return the points that are left, whose determinant with unit diagonal is not above the least."""
        run = kernel("track_inverses", Size, Double, Doubles, Bytes)
        if run is None or not run(len(self.rank), least_determinant, self.columns, self.rank):
            return np.empty(0, dtype=np.int64)
        return np.flatnonzero(self.rank == np.iinfo(np.uint8).max)

    def whiten(
        self,
        observations: tuple[FloatArray, FloatArray, IndexArray],
        used: BoolArray,
        limits: tuple[int, float],
        out: tuple[FloatArray, BoolArray],
    ) -> tuple[FloatArray, float, float]:
        """Write what is known of the used observations; return each track's sum of squares (P,) off its point.

        Then what the points' steps remove of the sum of squares, and that sum.

        observations : as `sums` got them        limits : min_track_length, min_eigenvalue
        used : (n,) may be the memory of what is verified
        out : whitened (2, n) px and verified (n,), see `audit.noise.tracks.TrackStatistics`
        """
        residuals_px, point_jacobian, point_idx = observations
        track_sq, removed = np.zeros(len(self.rank)), np.zeros(2)
        of_rows = (Size, Doubles, Doubles, SmallInts, Bytes)
        run = kernel("track_whiten", *of_rows, Doubles, Double, Double, Doubles, Bytes, Doubles, Doubles)
        if run is not None:
            n = point_idx.size
            rows = (n, residuals_px, point_jacobian, small_ints(point_idx, n), used.view(np.uint8))
            run(*rows, self.columns, *map(float, limits), out[0], out[1].view(np.uint8), track_sq, removed)
        return track_sq, float(removed[0]), float(removed[1])


def track_others(
    tracks: tuple[FloatArray, Int32Array], observations: tuple[Int32Array, FloatArray, BoolArray], rows: range
) -> tuple[FloatArray, Int32Array] | None:
    """Return what is left of a track without an observation, for each of ``rows``.

    Parameters
    ----------
    tracks : sum of squares (P,) px^2 and degrees of freedom (P,)
    observations : track (n,), whitened (2, n) px, verified (n,)

    Returns
    -------
    tuple
        sums of squares (m,) px^2, NaN where not verified, and degrees of freedom (m,); None for the numpy path
    """
    run = kernel("track_others", Size, Size, Size, SmallInts, Doubles, SmallInts, Doubles, Bytes, Doubles, SmallInts)
    (track_sq, dof), (point_idx, whitened_px, verified) = tracks, observations
    if run is None or rows.step != 1:
        return None
    own = point_idx[rows.start : rows.stop]
    if own.size and not (own.min() >= 0 and own.max() < track_sq.size == dof.size):
        raise IndexError(f"observations of tracks beyond the {track_sq.size} there are")
    if whitened_px.shape != (2, point_idx.size) or verified.shape != point_idx.shape:
        raise ValueError("observations are not of one size")
    out = np.empty(own.size), np.empty(own.size, dtype=np.int32)
    run(point_idx.size, rows.start, own.size, point_idx, track_sq, dof, whitened_px, verified.view(np.uint8), *out)
    return out


def sums(
    residuals_px: FloatArray, point_jacobian: FloatArray, point_idx: IndexArray, used: BoolArray, num_points: int
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
    run = kernel("track_sums", Size, Doubles, Doubles, SmallInts, Bytes, Doubles)
    if run is not None:
        run(n, residuals_px, point_jacobian, small_ints(point_idx, n), used.view(np.uint8), points.columns)
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
    def of(cls, e: FloatArray, others: Others, used: BoolArray | None = None) -> PriorGroups | None:
        """Group observations by their degrees of freedom; None where the kernels are not to be used.

        Parameters
        ----------
        e : (2, n) whitened residuals, px, or (n,) squares of their lengths
        others : the other observations' sums of squares and degrees of freedom
        used : (n,) which of them; all when None
        """
        count = kernel("prior_counts", Size, Bytes, SmallInts, Size, Ints)
        run = kernel("prior_groups", Size, Size, Size, Bytes, Doubles, Size, Doubles, SmallInts, Ints, Doubles, Doubles)
        if count is None or run is None:
            return None
        n = e.shape[-1]
        mask = np.ones(n, dtype=np.bool_) if used is None else used
        pieces = [slice(start, min(start + _AT_ONCE, n)) for start in range(0, n, _AT_ONCE)]
        if mask.shape != (n,) or e.shape not in {(n,), (2, n)}:
            raise ValueError("residuals, sums of squares, degrees of freedom and mask are not of one size")
        of_dof = np.zeros(1, dtype=np.int64)
        for piece in pieces:
            dof = others.dof(piece)
            _check_size(piece, dof)
            of_dof = np.pad(of_dof, (0, max(int(dof.max()) + 1 - of_dof.size, 0)))
            if count(dof.size, mask[piece].view(np.uint8), dof, of_dof.size, of_dof):
                raise ValueError("degrees of freedom are negative")
        rows = np.concatenate([[0], np.cumsum(-(-of_dof // _LANES) * _LANES)])
        sq, other = np.zeros(rows[-1]), np.full(rows[-1], 2.0**1000)
        given, following = (mask.view(np.uint8), np.ascontiguousarray(e), int(e.ndim == 1)), rows[:-1].copy()
        for piece in pieces:
            other_sq, dof = others.of(piece)
            _check_size(piece, dof, other_sq)
            run(n, piece.start, dof.size, *given, np.ascontiguousarray(other_sq), dof, following, sq, other)
        there = np.flatnonzero(of_dof)
        return cls(there.astype(np.float64), of_dof[there], np.append(rows[there], rows[-1]), sq, other)

    def sums_of_squares(self) -> tuple[float, float]:
        """Return the sums of q and of c."""
        of_groups = zip(self.starts.tolist(), self.counts.tolist(), strict=False)
        return float(self.sq_px2.sum()), sum(float(self.other_sq_px2[at : at + num].sum()) for at, num in of_groups)

    def sums(self, prior_sq: float) -> FloatArray:
        """Return sums (g, 6) of ln(b / (b + q)), ln(b + q), 1 / b, 1 / (b + q) and their squares with b = prior_sq + c.

        prior_sq and all sums of squares within 1e-140 .. 1e140.
        """
        out = np.empty((len(self.dof), 6))
        run = kernel("prior_sums", Size, Ints, Ints, Doubles, Doubles, Double, Doubles)
        if run is not None:
            run(len(self.dof), self.starts, self.counts, self.sq_px2, self.other_sq_px2, prior_sq, out)
        return out


def _check_size(piece: slice, *arrays: FloatArray | Int32Array) -> None:
    """Raise unless there is a value for each observation of a piece."""
    if any(array.shape != (piece.stop - piece.start,) for array in arrays):
        raise ValueError("residuals, sums of squares, degrees of freedom and mask are not of one size")
