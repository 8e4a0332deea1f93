"""Hull and cells against known answers and SciPy's hull of all points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from sfm_audit.audit.camera_quality.coverage import coverage, hull_area_px2, occupied_cells


@given(seed=st.integers(0, 10_000), n=st.integers(13, 400), integer=st.booleans())
def test_thinning_keeps_every_point_of_the_hull(seed, n, integer):
    rng = np.random.default_rng(seed)
    xy = rng.normal(size=(n, 2)) * [300, 200] + 500
    if integer:  # many ties in every direction
        xy = np.round(xy / 100)
    assert hull_area_px2(xy) == pytest.approx(ConvexHull(xy).volume, rel=1e-9)


def test_known_areas():
    square = np.array([[0, 0], [1600, 0], [1600, 1200], [0, 1200], [800, 600]], dtype=float)
    assert coverage(square, 1600, 1200) == pytest.approx(1.0)
    assert coverage(square * 1.5, 1600, 1200) == pytest.approx(2.25)  # not clipped
    assert hull_area_px2(square[:2]) == 0.0
    assert hull_area_px2(np.linspace([0, 0], [100, 50], 40)) == 0.0
    assert hull_area_px2(np.tile([[3.0, 4.0]], (50, 1))) == 0.0
    assert np.isnan(coverage(square, 0, 1200))


def test_cells():
    xy = np.array([[0.5, 0.5], [1.0, 1.0], [1599.5, 1199.5], [1600.0, 5.0], [-0.1, 3.0]])
    assert occupied_cells(xy, 1600, 1200, 8) == 2  # the two that lie outside are in no cell
    centres = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) * [200, 150]
    assert occupied_cells(centres, 1600, 1200, 8) == 64
    assert occupied_cells(np.empty((0, 2)), 1600, 1200, 8) == 0
