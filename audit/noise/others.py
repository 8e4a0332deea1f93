"""What a track says without one of its observations (method.md (3)): kept by row, or made of what is kept by track.

A model has several times as many observations as tracks: what follows from the track is made when it is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sfm_audit.audit.kernels.tracks import track_others
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

EVERY = slice(None)


class Others(Protocol):
    """What is known of n observations by the other observations of their tracks."""

    def of(self, rows: slice | IntArray) -> tuple[FloatArray, Int32Array]:
        """Return nu_k a_k^2 of (3), px^2, NaN where not verified, and nu_k = 2 L - 2 - rank of some observations."""

    def dof(self, rows: slice) -> Int32Array:
        """Return nu_k alone."""

    def lengths(self, rows: slice) -> Int32Array:
        """Return L, audited observations of the track, of some observations."""


@dataclass(frozen=True, slots=True, eq=False)
class ByRow:
    """`Others` that are kept as they are given: nu_k a_k^2, nu_k, L, (n,) each."""

    sq_px2: FloatArray
    all_dof: Int32Array | IntArray
    track_length: Int32Array | IntArray

    def of(self, rows: slice | IntArray) -> tuple[FloatArray, Int32Array]:
        """See `Others`."""
        return self.sq_px2[rows], self.dof(rows)

    def dof(self, rows: slice | IntArray) -> Int32Array:
        """See `Others`."""
        return self.all_dof[rows].astype(np.int32, copy=False)

    def lengths(self, rows: slice) -> Int32Array:
        """See `Others`."""
        return self.track_length[rows].astype(np.int32, copy=False)


@dataclass(frozen=True, slots=True, eq=False)
class TrackTable:
    """Tracks (P,): sq_px2, sum of squares off the track's point; dof, 2 L - 2 - rank; length, L."""

    sq_px2: FloatArray
    dof: Int32Array
    length: Int32Array


@dataclass(frozen=True, slots=True, eq=False)
class ByTrack:
    """`Others` that are made of their tracks.

    point_idx: (n,) row in the tables.    whitened_px: (2, n).    verified: (n,)
    tables: of the tracks without what is left out, and of the full ones if something is.
    left_out: (n,) observations that are told by the full tracks; None: nothing is.
    """

    point_idx: Int32Array
    whitened_px: FloatArray
    verified: BoolArray
    tables: tuple[TrackTable, ...]
    left_out: BoolArray | None

    def of(self, rows: slice | IntArray) -> tuple[FloatArray, Int32Array]:
        """See `Others`."""
        sq_px2, dof = self._of(self.tables[0], rows)
        if self.left_out is None or not (full := self.left_out[rows]).any():
            return sq_px2, dof
        of_full = self._of(self.tables[-1], rows)
        return np.where(full, of_full[0], sq_px2), np.where(full, of_full[1], dof)

    def dof(self, rows: slice) -> Int32Array:
        """See `Others`."""
        return self._of_tracks([table.dof for table in self.tables], rows)

    def lengths(self, rows: slice) -> Int32Array:
        """See `Others`."""
        return self._of_tracks([table.length for table in self.tables], rows)

    def _of_tracks(self, columns: Sequence[Int32Array], rows: slice) -> Int32Array:
        """Return a column of the tables for the tracks of some observations."""
        found = columns[0].take(self.point_idx[rows])
        if self.left_out is None or not (full := self.left_out[rows]).any():
            return found
        return np.where(full, columns[-1].take(self.point_idx[rows]), found)

    def _of(self, table: TrackTable, rows: slice | IntArray) -> tuple[FloatArray, Int32Array]:
        if isinstance(rows, slice):
            of_observations = (self.point_idx, self.whitened_px, self.verified)
            found = track_others((table.sq_px2, table.dof), of_observations, range(*rows.indices(self.verified.size)))
            if found is not None:
                return found
        point_idx = self.point_idx[rows]
        x, y = self.whitened_px[:, rows]
        other = table.sq_px2.take(point_idx) - (x * x + y * y)  # (3)
        other = np.where(self.verified[rows], np.maximum(other, 0.0), np.nan)
        return other, table.dof.take(point_idx)
