"""Do neighbours in a sequence share their errors? Von Neumann's ratio, for findings about drift.

H0: errors of successive images are independent, of equal covariance. Assumes that the order of the names is that of the
photos. A fit to the errors takes their smoothest parts up, which makes the test careful.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from sfm_audit.loaders.arrays import FloatArray


def smoothness_p(errors: FloatArray) -> float:
    """Return the p-value of errors (n, k) in the order of a sequence, against independent ones; 1 where n < 4.

    Notes
    -----
    sum |e_i+1 - e_i|^2 / sum |e_i - mean|^2 has mean 2 and variance 4 (n - 2) / (n^2 - 1) per coordinate (von Neumann
    1941); over k coordinates of equal size the variance falls by k. Small: errors are smooth.
    """
    n = len(errors)
    centred = errors - errors.mean(axis=0)
    total = float((centred**2).sum())
    if n < 4 or not total > 0:
        return 1.0
    ratio = float((np.diff(errors, axis=0) ** 2).sum()) / total
    weights = (centred**2).sum(axis=0) / total
    sd = np.sqrt(4.0 * (n - 2) / (n * n - 1) * float((weights**2).sum()))
    return float(ndtr((ratio - 2.0) / sd))


def shared_rms(errors: FloatArray) -> float:
    """Return the RMS of the part of errors (n, k) that successive ones share, 0 for independent ones."""
    centred = errors - errors.mean(axis=0)
    shared = float((centred**2).sum()) - 0.5 * float((np.diff(errors, axis=0) ** 2).sum())
    return float(np.sqrt(max(shared, 0.0) / max(len(errors), 1)))
