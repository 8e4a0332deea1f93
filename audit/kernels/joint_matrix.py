"""Symmetric matrices of blocks between pairs of images: products, and their entries in order (`joint_matrix.c`)."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import FloatArray, IntArray

_DONE: Final = 0
_BLOCKS: Final = (*([Size] * 4), Ints, Ints, Doubles)


class Blocks(NamedTuple):
    """A + A^T (D, D) of the blocks (m, r, c) of A at rows (m, r) and columns (m, c); D is padding."""

    size: int
    rows: IntArray
    columns: IntArray
    blocks: FloatArray


def checked_blocks(given: Blocks) -> Blocks:
    """Return them as the kernels of this module take them; ValueError where an index is none."""
    size, rows, columns, blocks = given
    num, height, width = blocks.shape
    if rows.shape != (num, height) or columns.shape != (num, width):
        raise ValueError("blocks of another matrix")
    if blocks.size and min(int(rows.min()), int(columns.min())) < 0:
        raise ValueError("blocks of another matrix")
    first, second = (np.ascontiguousarray(each, dtype=np.int64) for each in (rows, columns))
    return Blocks(size, first, second, doubles(blocks, blocks.shape))


def times_blocks(given: Blocks, values: FloatArray) -> FloatArray | None:
    """The matrix times values (D, c); None for the numpy path."""
    function = kernel("joint_times", *_BLOCKS, Size, Doubles, Doubles)
    if function is None:
        return None
    count = values.shape[1]
    checked, out = doubles(values, (given.size, count)), np.empty((given.size, count))
    status = function(given.size, *given.blocks.shape, *given[1:], count, checked, out)
    return out if status == _DONE else None


class BandPlaces(NamedTuple):
    """The order of a band, see `sfm_audit.audit.joint.band.Band`: place (D,) of each column, starts (b + 1,)."""

    place: IntArray
    starts: IntArray


def band_of_blocks(
    given: Blocks, order: BandPlaces, scale: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """E (A + A^T) E by place, E diagonal, ``scale`` (D,): blocks on the diagonal, blocks below them, border (D, m).

    Blocks follow each other in one piece, (w_i, w_i) and (w_(i+1), w_i).
    None for the numpy path, and where the matrix is no such band.
    """
    function = kernel("joint_band", *_BLOCKS, Ints, Ints, Ints, Size, Ints, Ints, *([Doubles] * 4))
    size, num_blocks = given.size, len(order.starts) - 1
    place, starts = ints(order.place, size), ints(order.starts, num_blocks + 1)
    widths, num_banded = np.diff(starts), int(starts[-1])
    if starts[0] != 0 or (widths < 0).any() or num_banded > size:
        raise ValueError("blocks of another band")
    if size and not (place.min() >= 0 and place.max() < size):
        raise ValueError("places of another matrix")
    if function is None:
        return None
    sizes, below_sizes = widths * widths, np.append(widths[1:], 0) * widths
    places = np.cumsum(sizes) - sizes, np.cumsum(below_sizes) - below_sizes
    diagonal, below, border = np.zeros(sizes.sum()), np.zeros(below_sizes.sum()), np.zeros((size, size - num_banded))
    number = np.repeat(np.arange(num_blocks), widths)
    of_band = place, number, starts, num_blocks, *places, doubles(scale, (size,))
    status = function(size, *given.blocks.shape, *given[1:], *of_band, diagonal, below, border)
    return (diagonal, below, border) if status == _DONE else None
