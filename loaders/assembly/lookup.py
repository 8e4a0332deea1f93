"""From stored ids to rows."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import Int32Array, UInt32Array, UInt64Array

_MAX_TABLE_PER_ID: Final = 16
_CHUNK: Final = 1 << 16  # ids at a time: what is made on the way stays in the cache
_TOO_MANY: Final = 1 << 31  # for rows of 32 bits


def rows_of(sorted_ids: UInt64Array, ids: UInt64Array | UInt32Array) -> Int32Array:
    """Return the row of each of ``ids`` in ``sorted_ids``, -1 where it is not there."""
    if len(sorted_ids) >= _TOO_MANY:
        raise ValueError(f"expected fewer than 2^31 ids, found {len(sorted_ids)}")
    out = np.full(len(ids), -1, dtype=np.int32)
    if len(sorted_ids) == 0:
        return out
    size = int(sorted_ids[-1]) + 1
    if size <= _MAX_TABLE_PER_ID * len(sorted_ids):  # dense ids: a table is faster than a search
        table = np.full(size + 1, -1, dtype=np.int32)
        table[sorted_ids] = np.arange(len(sorted_ids), dtype=np.int32)
        largest = ids.dtype.type(min(size, int(np.iinfo(ids.dtype).max)))
        for start in range(0, len(ids), _CHUNK):
            part = slice(start, start + _CHUNK)
            out[part] = table.take(np.minimum(ids[part], largest), mode="clip")
        return out
    for start in range(0, len(ids), _CHUNK):
        part = slice(start, start + _CHUNK)
        rows = np.searchsorted(sorted_ids, ids[part])
        rows[rows == len(sorted_ids)] = 0
        np.copyto(out[part], rows, where=sorted_ids[rows] == ids[part], casting="same_kind")
    return out
