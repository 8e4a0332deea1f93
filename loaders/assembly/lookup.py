"""From stored ids to rows."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import IntArray, UInt32Array, UInt64Array

_MAX_TABLE_PER_ID: Final = 16


def rows_of(sorted_ids: UInt64Array, ids: UInt64Array | UInt32Array) -> IntArray:
    """Return the row of each of ``ids`` in ``sorted_ids``, -1 where it is not there."""
    if len(sorted_ids) == 0:
        return np.full(len(ids), -1, dtype=np.int64)
    size = int(sorted_ids[-1]) + 1
    if size <= _MAX_TABLE_PER_ID * len(sorted_ids):  # dense ids: a table is faster than a search
        table = np.full(size + 1, -1, dtype=np.int32)
        table[sorted_ids] = np.arange(len(sorted_ids), dtype=np.int32)
        largest = ids.dtype.type(min(size, int(np.iinfo(ids.dtype).max)))
        return table.take(np.minimum(ids, largest), mode="clip").astype(np.int64)
    rows = np.searchsorted(sorted_ids, ids)
    rows[rows == len(sorted_ids)] = 0
    return np.where(sorted_ids[rows] == ids, rows, -1).astype(np.int64)
