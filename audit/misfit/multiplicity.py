"""What is left of a p-value when many were looked at? method.md section 7.

Holm over the hypotheses of one image, Benjamini-Hochberg over the images of one model.
"""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.arrays import FloatArray


def holm(p: FloatArray) -> FloatArray:
    """Holm's adjusted p-values: rejecting where they are below alpha keeps P(any false rejection) below alpha.

    Valid under every kind of dependence.

    Parameters
    ----------
    p : (..., m)
        p-values of m hypotheses along the last axis, in [0, 1]; NaN = not tested, and not counted.

    Returns
    -------
    (..., m)
        In the order of p, at least p and at most 1; NaN where p is NaN.

    Raises
    ------
    ValueError
        If a p-value lies outside [0, 1].

    Notes
    -----
    Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6 (1979) 65-70.
    """
    order, p_sorted, num_tested = _ascending(p)
    factor = num_tested - np.arange(p.shape[-1])  # the i-th smallest of m is compared with m - i + 1 others
    adjusted = np.fmin(1.0, np.fmax.accumulate(p_sorted * np.maximum(factor, 1), axis=-1))
    return _restore(adjusted, order, p)


def benjamini_hochberg(p: FloatArray) -> FloatArray:
    """Benjamini and Hochberg's q-values: of those with q below alpha, at most a share alpha is false on average.

    Valid for independent and for positively dependent tests.

    Parameters
    ----------
    p : (..., m)
        p-values of m hypotheses along the last axis, in [0, 1]; NaN = not tested, and not counted.

    Returns
    -------
    (..., m)
        In the order of p, at least p and at most 1; NaN where p is NaN.

    Raises
    ------
    ValueError
        If a p-value lies outside [0, 1].

    Notes
    -----
    Benjamini & Hochberg, "Controlling the false discovery rate", JRSS B 57 (1995) 289-300; q_(i) = min over j >= i of
    p_(j) m / j, with m the number of p-values that are not NaN.
    """
    order, p_sorted, num_tested = _ascending(p)
    raw = p_sorted * (num_tested / np.arange(1, p.shape[-1] + 1))
    # Each quotient is at least p; rounding of m / j * p at j = m must not undercut it.
    adjusted = np.fmin.accumulate(raw[..., ::-1], axis=-1)[..., ::-1]
    return _restore(np.fmin(1.0, np.fmax(adjusted, p_sorted)), order, p)


def _ascending(p: FloatArray) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], FloatArray, FloatArray]:
    """Order, p in that order (NaN last) and the number of tested hypotheses (..., 1)."""
    if np.any((p < 0.0) | (p > 1.0)):
        message = f"p-values must lie in [0, 1]; found {p[(p < 0.0) | (p > 1.0)][0]}"
        raise ValueError(message)
    order = np.argsort(p, axis=-1, kind="stable").astype(np.int64)
    tested = np.count_nonzero(~np.isnan(p), axis=-1, keepdims=True).astype(np.float64)
    return order, np.take_along_axis(p, order, axis=-1), tested


def _restore(
    adjusted_sorted: FloatArray, order: np.ndarray[tuple[int, ...], np.dtype[np.int64]], p: FloatArray
) -> FloatArray:
    """Back in the order of p, with p's NaN."""
    result = np.empty_like(adjusted_sorted)
    np.put_along_axis(result, order, adjusted_sorted, axis=-1)
    return np.where(np.isnan(p), np.nan, result)
