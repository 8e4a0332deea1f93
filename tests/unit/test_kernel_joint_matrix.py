"""Symmetric matrices of blocks of pairs of images: as scipy and numpy make them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.joint.matrix import PairMatrix, operator_of
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint_matrix import (
    BandPlaces,
    Blocks,
    band_of_blocks,
    checked_blocks,
    times_blocks,
)

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")


@pytest.mark.parametrize("size", [1, 7, 63, 64, 65, 130])
def test_blocks_make_the_symmetric_matrix_that_scipy_makes(size):
    """Places met once, twice and never, the padding, and blocks of which a column comes twice."""
    rng = np.random.default_rng(size)
    rows, columns = rng.integers(0, size + 1, (40, 3)), rng.integers(0, size + 1, (40, 5))
    blocks = rng.normal(size=(40, 3, 5))
    expected = np.zeros((size + 1, size + 1))
    np.add.at(expected, (rows[:, :, None], columns[:, None, :]), blocks)
    expected = (expected + expected.T)[:size, :size]
    given = checked_blocks(Blocks(size, rows, columns, blocks))
    values = rng.normal(size=(size, 13))
    for some in (values[:, :1], values[:, :3], values[:, :8], values):
        assert_allclose(times_blocks(given, some), expected @ some, atol=1e-13)
    matrix = PairMatrix(Blocks(size, rows, columns, blocks), np.arange(size), (0, 1, 2))
    assert_allclose(operator_of(matrix) @ values[:, 0], expected @ values[:, 0], atol=1e-13)
    with numpy_only():
        assert times_blocks(given, values) is None
        alone = PairMatrix(Blocks(size, rows, columns, blocks), np.arange(size), (0, 1, 2))
        assert_allclose(alone.toarray(), expected, atol=1e-13)
        assert_allclose(alone @ values, expected @ values, atol=1e-13)


def test_what_a_block_has_in_a_place_that_is_padding_counts_for_nothing():
    rows = columns = np.array([[0, 1, 2]])
    blocks = np.full((1, 3, 3), np.nan)
    blocks[0, :2, :2] = [[1.0, 2.0], [3.0, 4.0]]
    for count in (1, 2):
        found = times_blocks(checked_blocks(Blocks(2, rows, columns, blocks)), np.ones((2, count)))
        assert_allclose(found, np.repeat([[7.0], [13.0]], count, axis=1))


def test_the_diagonal_is_what_stands_at_equal_rows_and_columns():
    """Poses of three columns and cameras of two, the first of which two images share; a column that nothing has."""
    of_image = np.array([[0, 1, 2, 9, 10], [3, 4, 5, 9, 10], [6, 7, 8, 11, 13]])
    rng, (first, second) = np.random.default_rng(1), np.array([[0, 0, 1, 2, 2], [0, 1, 1, 1, 2]])
    blocks = rng.normal(size=(5, 5, 5))
    expected = np.zeros((14, 14))
    np.add.at(expected, (of_image[first][:, :, None], of_image[second][:, None, :]), blocks)
    expected = (expected + expected.T)[:13, :13]
    group = np.repeat(np.arange(6), [3, 3, 3, 2, 1, 1])
    matrix = PairMatrix(Blocks(13, of_image[first], of_image[second], blocks), group, (0, 3))
    assert_allclose(matrix.diagonal(), expected.diagonal(), atol=1e-15)
    assert matrix.diagonal()[12] == 0.0
    couples = np.zeros((6, 6))
    couples[group[:, None], group] = expected != 0
    assert_array_equal(matrix.pattern().toarray(), couples)


def test_blocks_that_are_too_wide_are_left_to_scipy():
    given = Blocks(40, np.arange(2)[None], np.arange(40)[None], np.ones((1, 2, 40)))
    assert times_blocks(checked_blocks(given), np.ones((40, 1))) is None
    matrix = PairMatrix(given, np.arange(40), (0,))
    assert_allclose(matrix @ np.ones((40, 1)), matrix.toarray().sum(axis=1)[:, None])


def test_blocks_of_another_matrix_or_band_never_reach_the_kernel():
    rng = np.random.default_rng(3)
    rows = columns = np.array([[0, 1], [2, 3]])
    given = Blocks(4, rows, columns, rng.normal(size=(2, 2, 2)))
    for wrong in (given._replace(rows=rows - 5), given._replace(rows=rows[:, :1]), given._replace(columns=rows[:1])):
        with pytest.raises(ValueError, match="another matrix"):
            checked_blocks(wrong)
    with pytest.raises(ValueError, match="expected an array of shape"):
        times_blocks(given, np.zeros((3, 1)))
    order = BandPlaces(np.arange(4), np.array([0, 2, 4]))
    diagonal, below, border = band_of_blocks(given, order, np.ones(4))
    expected = given.blocks + given.blocks.transpose(0, 2, 1)
    assert_allclose(diagonal, expected.ravel())
    assert (below.tolist(), border.shape) == ([0.0] * 4, (4, 0))
    for wrong, told in (
        (BandPlaces(np.arange(4) + 1, order.starts), "places"),
        (BandPlaces(order.place, rows[1]), "band"),
    ):
        with pytest.raises(ValueError, match=told):
            band_of_blocks(given, wrong, np.ones(4))
    far = given._replace(columns=np.array([[2, 3], [0, 1]]))
    assert band_of_blocks(far, BandPlaces(np.arange(4), np.array([0, 1, 2, 3, 4])), np.ones(4)) is None
    with numpy_only():
        assert band_of_blocks(given, order, np.ones(4)) is None
