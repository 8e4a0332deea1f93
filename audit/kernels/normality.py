"""Statistics of many samples of 2-vectors for the tests of normality: normality.c."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
from scipy import special

from sfm_audit.audit.kernels.library import Bytes, Doubles, Ints, Size, kernel, kernels_in_use
from sfm_audit.loaders.arrays import BoolArray, FloatArray

COLUMNS: Final = (
    *("ks", "ks_fitted", "ks_norm", "ks_norm_unscaled"),
    *("m2", "m3", "m4"),
    *("score_sq", "score_1", "score_2", "projection_rest", "span_1", "span_2", "total_sq"),
)
"""Statistics of a sample: four distances of Kolmogorov's, the central moments of the pooled values, and for Shapiro and
Wilk, of at most 5000 values: the sum of all scores squared, the two largest scores, the sum of the others times the
differences of opposite values, the differences of the outermost and the next two, the sum of squares about the mean."""
_NUM_NODES: Final = 541
_NODES_PER_UNIT: Final = 64.0


def available() -> bool:
    """Whether the functions of this module can be called."""
    return kernels_in_use()


@cache
def _tails() -> FloatArray:
    """1 - Phi and the normal density (541, 2) at 0, 1 / 64, 2 / 64 ..."""
    nodes = np.arange(_NUM_NODES) / _NODES_PER_UNIT
    return np.stack([special.ndtr(-nodes), np.exp(-0.5 * nodes * nodes) / math.sqrt(2.0 * math.pi)], axis=1)


def statistics(samples: Sequence[FloatArray], out: FloatArray) -> BoolArray:
    """Write `COLUMNS` (B, c) of samples (n, 2) into ``out``; return which of them could be told (B,)."""
    run = kernel("normality_statistics", Size, Ints, Doubles, Doubles, Doubles, Bytes)
    status = np.ones(len(samples), dtype=np.uint8)
    found: BoolArray = status == 0
    if run is None or not samples:
        return found
    offsets = np.zeros(len(samples) + 1, dtype=np.int64)
    np.cumsum([len(z) for z in samples], out=offsets[1:])
    z = np.concatenate(samples)
    run(len(samples), offsets, np.ascontiguousarray(z, dtype=np.float64), _tails(), out, status)
    return np.equal(status, 0, out=found)
