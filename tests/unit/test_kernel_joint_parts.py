"""Entries of an inverse that the kernels look up: of a band, of a matrix, and what leads outside."""

import numpy as np
import pytest

from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.joint_parts import dense_entries, near_entries

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")


def test_entries_of_a_band_and_of_a_matrix():
    rng = np.random.default_rng(2)
    full = rng.normal(size=(10, 10))
    full = full + full.T
    blocks = [full[0:4, 0:10], full[4:8, 4:10], full[8:10, 8:10]]
    place = np.array([1, 2, 5, 9])

    def entries(blocks, at=place):
        starts = np.cumsum([0, *(block.size for block in blocks)])
        columns = np.array([block.shape[1] for block in blocks])
        first = np.array([0, 4, 8, 10])[: len(blocks) + 1]
        return near_entries(at, first, np.concatenate([block.ravel() for block in blocks]), starts, columns)

    np.testing.assert_array_equal(entries(blocks), full[np.ix_(place, place)])
    assert entries([blocks[0][:, :8], *blocks[1:]]) is None
    assert entries(blocks[:2]) is None
    assert entries(blocks, np.array([8, 11])) is None
    with pytest.raises(ValueError, match="another band"):
        near_entries(place, np.array([0, 4]), np.zeros(3), np.array([0, 4]), np.array([2]))
    with pytest.raises(ValueError, match="another band"):
        near_entries(place, np.array([0, 1, 2]), np.zeros(4), np.array([0, 4]), np.array([2]))
    np.testing.assert_array_equal(dense_entries(full, place[::-1].copy()), full[np.ix_(place[::-1], place[::-1])])
    assert dense_entries(full, np.array([0, 10])) is None
    assert dense_entries(full[:, ::2], np.array([0])) is None
