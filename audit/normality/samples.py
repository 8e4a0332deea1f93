"""Can a sample be tested at all, and can its fourth powers be computed? Shared by all tests."""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

# Fourth powers of magnitudes between these, and sums of up to 1e8 of them, stay inside float64.
SAFE_MAGNITUDE = (1e-70, 1e70)


def is_finite_sample(values: FloatArray) -> bool:
    """At least one value, and no NaN or infinity among them."""
    return bool(values.size) and bool(np.isfinite(values).all())


def in_safe_range(values: FloatArray) -> FloatArray:
    """Finite values, divided by their largest magnitude where powers of it would overflow or vanish.

    Only for statistics that do not depend on the unit of the values.
    """
    magnitude = max(float(values.max()), -float(values.min()))
    if magnitude == 0.0 or SAFE_MAGNITUDE[0] < magnitude < SAFE_MAGNITUDE[1]:
        return values
    return np.asarray(values / magnitude)
