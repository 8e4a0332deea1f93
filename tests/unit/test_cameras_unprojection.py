"""The way back along the radius against Newton's method in the plane, and against the roots of the polynomial."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.cameras.inverse import undistort
from sfm_audit.audit.cameras.warps import radial

COEFFICIENTS = [(0.1,), (-0.2,), (-0.3, 0.05), (0.02, -0.4, 0.1), (1.5, 0.7, -0.3, 0.01), (-40.0,)]


def in_the_plane(u, v, extra, want):
    """The same warp, which `undistort` does not know to be radial."""
    return radial(u, v, extra, want)


@pytest.mark.parametrize("extra", COEFFICIENTS)
def test_along_the_radius_as_in_the_plane(extra):
    rng = np.random.default_rng(1)
    x, y = np.concatenate([s * rng.standard_normal((2, 100)) for s in (0.01, 0.3, 2.0)], axis=1)
    x[0] = y[0] = y[1] = 0.0
    x[2] = np.nan
    with np.errstate(all="ignore"):
        ours, plane = undistort(radial, extra, x, y), undistort(in_the_plane, extra, x, y)
    assert_array_equal(np.isnan(ours), np.isnan(plane))
    assert_allclose(ours, plane, rtol=1e-12, atol=1e-15)
    assert 0 < np.isfinite(ours[0]).sum() < len(x)


@pytest.mark.parametrize("extra", COEFFICIENTS)
def test_the_radius_is_the_first_root(extra):
    """NumPy's companion matrix: the smallest positive root of r + k1 r^3 + .. = R, wherever it comes before a fold."""
    distorted = np.linspace(0.02, 1.5, 60)
    with np.errstate(all="ignore"):
        ours = undistort(radial, extra, distorted, np.zeros(60))[0]
    odd = np.zeros(2 * len(extra) + 2)
    odd[0::2] = [*extra[::-1], 1.0]
    turns = np.roots(np.polyder(odd))
    fold = min(turns[(np.abs(turns.imag) < 1e-9) & (turns.real > 0)].real, default=np.inf)
    for goal, radius in zip(distorted, ours, strict=True):
        roots = np.roots(odd - goal * np.eye(len(odd))[-1])
        first = min(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real, default=np.inf)
        if first < 0.99 * fold:
            assert_allclose(radius, first, rtol=1e-9)
        elif first > fold:
            assert np.isnan(radius)
