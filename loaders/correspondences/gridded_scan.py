"""A laser scan as the scanner's grid, rows in tilt and columns in pan, and the neighbours of its points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sfm_audit.loaders.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class GriddedScan:
    """One scan.

    xyz_world: (rows, columns, 3) model units, after the file's transformation; NaN where nothing came back. Rows are
    steps in tilt (the vertical angle), columns steps in pan (the horizontal one).
    path: where it was read from, for messages.
    """

    xyz_world: FloatArray
    path: str = "the scan"


@dataclass(frozen=True, slots=True, eq=False)
class ScanNeighbours:
    """The points beside some points of a scan.

    pan_xyz_world, tilt_xyz_world: (n, 3) model units, in the next (or else the previous) column and row; NaN where
    there is none.          faults: why a point cannot be used, by its row; empty where all can.
    """

    pan_xyz_world: FloatArray
    tilt_xyz_world: FloatArray
    faults: Mapping[int, str]


def neighbours(scan: GriddedScan, xyz_world: FloatArray) -> ScanNeighbours:
    """Find points (n, 3) in a scan, and their neighbours in pan and tilt.

    Notes
    -----
    The point of the scan that is meant is the nearest one. It must lie closer than half the way to the nearer of its
    two neighbours: then no rounding of coordinates can have turned it into that neighbour. A point between points of
    the scan passes as the nearest of them; the step is the same there.

    A neighbour is taken from the next column or row; at the border, or where nothing came back, from the previous one.
    The distance is what matters, so a full turn needs no joint: its last column has the one before it.
    """
    has_return = np.isfinite(scan.xyz_world).all(axis=2)
    cell = np.flatnonzero(has_return)
    # building is what costs, the look-ups are few
    tree = cKDTree(scan.xyz_world[has_return], balanced_tree=False, compact_nodes=False)
    distance, nearest = (np.asarray(found) for found in tree.query(xyz_world))
    row, column = np.divmod(cell[nearest], scan.xyz_world.shape[1])
    point = scan.xyz_world[row, column]
    pan = _beside(scan.xyz_world, row, column, axis=1)
    tilt = _beside(scan.xyz_world, row, column, axis=0)
    steps = np.stack([np.linalg.norm(pan - point, axis=1), np.linalg.norm(tilt - point, axis=1)])
    faults: dict[int, str] = {}
    for i in np.flatnonzero(~(distance < 0.5 * steps.min(axis=0))).tolist():
        at = f"row {row[i]}, column {column[i]} (from 0)"
        lacking = [name for name, step in zip(("pan", "tilt"), steps[:, i], strict=True) if np.isnan(step)]
        if lacking:
            faults[i] = f"{at}, without a neighbour in {' and '.join(lacking)} on either side"
        else:
            step = steps[:, i].min()
            faults[i] = f"none: the nearest, {at}, is {distance[i]:.4g} away, its neighbour is {step:.4g} from it"
    return ScanNeighbours(pan, tilt, faults)


def _beside(grid: FloatArray, row: IntArray, column: IntArray, *, axis: int) -> FloatArray:
    """Return points (n, 3) one step further along ``axis``, or else one step back; NaN without either."""
    found = np.full((len(row), 3), np.nan)
    for step in (-1, 1):  # the later one counts
        index = [row, column]
        index[axis] = index[axis] + step
        exists = (index[axis] >= 0) & (index[axis] < grid.shape[axis])
        candidate = np.full_like(found, np.nan)
        candidate[exists] = grid[index[0][exists], index[1][exists]]
        found = np.where(np.isnan(candidate), found, candidate)
    return found
