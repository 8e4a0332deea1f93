"""What the tests need of a sample, before any of them asks how likely it is: one row of numbers for each sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import special

from sfm_audit.audit.kernels import normality as compiled
from sfm_audit.audit.kernels.normality import COLUMNS
from sfm_audit.audit.normality.many_values import MANY_POINTS, scores, statistics_of_many
from sfm_audit.audit.normality.samples import SAFE_MAGNITUDE
from sfm_audit.loaders.arrays import BoolArray, FloatArray

_MAX_VALUES_AT_ONCE: Final = 1 << 18


def sample_statistics(samples: Sequence[FloatArray]) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the statistics (B,) of samples (n, 2) by name, see `audit.kernels.normality.COLUMNS`, and which have any.

    Samples without points, not finite, all equal, or whose fourth powers float64 cannot hold have none.
    """
    out = np.full((len(samples), len(COLUMNS)), math.nan)
    found = compiled.statistics(samples, out) if compiled.available() else _by_numpy(samples, out)
    return dict(zip(COLUMNS, out.T, strict=True)), found


def _by_numpy(samples: Sequence[FloatArray], out: FloatArray) -> BoolArray:
    """Write rows of ``out``; small samples of one size together, at which numpy's overhead is paid once."""
    found = np.zeros(len(samples), dtype=np.bool_)
    by_size: dict[int, list[int]] = {}
    for k, z in enumerate(samples):
        by_size.setdefault(min(len(z), MANY_POINTS), []).append(k)
    many = [k for k in by_size.pop(MANY_POINTS, []) if _is_usual(samples[k].reshape(1, -1))[0]]
    if many:
        found[many], out[many] = True, statistics_of_many([samples[k] for k in many])
    for size, members in by_size.items():
        step = max(1, _MAX_VALUES_AT_ONCE // max(2 * size, 1))
        for start in range(0, len(members) if size else 0, step):
            part = np.array(members[start : start + step])
            stack = np.stack([samples[k] for k in part.tolist()])
            usual = _is_usual(stack)
            found[part[usual]] = True
            if usual.any():
                out[part[usual]] = _of_stack(stack[usual])
    return found


def _is_usual(stack: FloatArray) -> BoolArray:
    """(B,) samples that are finite, not all equal, and whose fourth powers can be computed."""
    flat = stack.reshape(len(stack), -1)
    low, high = flat.min(axis=1), flat.max(axis=1)
    magnitude = np.maximum(high, -low)
    usual: BoolArray = (low < high) & (magnitude > SAFE_MAGNITUDE[0]) & (magnitude < SAFE_MAGNITUDE[1])
    return usual


def _of_stack(stack: FloatArray) -> FloatArray:
    """Statistics (B, c) of samples (B, n, 2), n < MANY_POINTS.

    Sums along rows only: products with a vector and einsum add in an order that depends on how many samples there are.
    """
    values = np.ascontiguousarray(stack).reshape(len(stack), -1)
    num_values = values.shape[1]
    mean = values.mean(axis=1)
    deviation = values - mean[:, None]
    square = deviation * deviation
    m2 = square.mean(axis=1)
    m3, m4 = (square * deviation).mean(axis=1), (square * square).mean(axis=1)
    ascending = np.sort(values, axis=1)
    sd = np.sqrt(m2 * num_values / (num_values - 1))
    half_squares = np.sort(0.5 * (stack[:, :, 0] * stack[:, :, 0] + stack[:, :, 1] * stack[:, :, 1]), axis=1)
    columns = [
        _distances(special.ndtr(ascending)),
        _distances(special.ndtr((ascending - mean[:, None]) / sd[:, None])),
        _distances(-np.expm1(half_squares / -half_squares.mean(axis=1, keepdims=True))),
        _distances(-np.expm1(-half_squares)),
        *(m2, m3, m4),
        *_of_order(ascending),
    ]
    return np.stack(columns, axis=1)


def _distances(cdf: FloatArray) -> FloatArray:
    """Kolmogorov's D (B,) of distribution functions (B, N), ascending."""
    num_values = cdf.shape[1]
    excess = cdf - np.arange(1.0, num_values + 1.0) / num_values
    return np.asarray(np.maximum(excess.max(axis=1) + 1.0 / num_values, -excess.min(axis=1)))


def _of_order(ascending: FloatArray) -> list[FloatArray]:
    """Shapiro and Wilk's sums (B,) each over samples (B, N) in ascending order."""
    score, sq_sum = scores(ascending.shape[1])
    half = len(score)
    span = ascending[:, : -half - 1 : -1] - ascending[:, :half]
    deviation = ascending - ascending.mean(axis=1, keepdims=True)
    second, span_2 = (score[1], span[:, 1]) if half > 1 else (0.0, np.zeros(len(span)))
    ones = np.ones(len(ascending))
    constants = [sq_sum * ones, score[0] * ones, second * ones]
    projection_rest, total_sq = (span[:, 2:] * score[2:]).sum(axis=1), (deviation * deviation).sum(axis=1)
    return [*constants, projection_rest, span[:, 0], span_2, total_sq]
