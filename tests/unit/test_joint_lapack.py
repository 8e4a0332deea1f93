"""The functions of LAPACK and BLAS that give Python's lock away, beside those of SciPy that keep it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.linalg import blas, lapack

from sfm_audit.audit.joint.lapack import (
    cholesky_in_place,
    divided_by_factor,
    inverse_of_factor,
    solve_by_factor,
)


def positive(size: int) -> np.ndarray:
    root = np.random.default_rng(size).normal(size=(size, size + 3))
    return np.asfortranarray(root @ root.T)


@pytest.mark.parametrize("size", [0, 1, 2, 17, 240])
def test_they_say_what_scipy_says(size):
    matrix = positive(size)
    factor, right = matrix.copy(order="F"), np.random.default_rng(1).normal(size=(size, 5))
    assert cholesky_in_place(factor)
    expected = lapack.dpotrf(matrix, lower=1, clean=1)[0] if size else np.zeros((0, 0))
    assert_array_equal(np.tril(factor), expected)
    assert_array_equal(np.triu(factor, 1), np.triu(matrix, 1))  # left as it was
    if not size:
        assert solve_by_factor(factor, right).shape == right.shape
        assert divided_by_factor(right.T, factor, transposed=True).shape == right.T.shape
        return
    assert_array_equal(solve_by_factor(factor, right), lapack.dpotrs(expected, right, lower=1)[0])
    inverse = inverse_of_factor(factor)
    assert_array_equal(np.tril(inverse), np.tril(lapack.dpotri(expected, lower=1)[0]))
    np.testing.assert_allclose((np.tril(inverse) + np.tril(inverse, -1).T) @ matrix, np.eye(size), atol=1e-6)
    for transposed in (False, True):
        theirs = blas.dtrsm(1.0, expected, right.T, side=1, lower=1, trans_a=int(transposed))
        assert_array_equal(divided_by_factor(right.T, factor, transposed=transposed), theirs)
    assert_array_equal(np.tril(factor), expected)  # what is only read stays
    assert inverse_of_factor(factor, in_place=True) is factor
    assert_array_equal(np.tril(factor), np.tril(inverse))


def test_a_matrix_without_a_factor():
    assert not cholesky_in_place(np.asfortranarray([[1.0, 2.0], [2.0, 1.0]]))
    assert not cholesky_in_place(np.asfortranarray([[-1.0]]))


def test_right_sides_in_any_order():
    factor = positive(6)
    assert cholesky_in_place(factor)
    right = np.random.default_rng(2).normal(size=(6, 4))
    for given in (right, np.asfortranarray(right), np.repeat(right, 2, axis=1)[:, ::2]):
        assert_array_equal(solve_by_factor(factor, given), solve_by_factor(factor, right))
        np.testing.assert_allclose(
            solve_by_factor(factor, np.float32(given)), solve_by_factor(factor, right), rtol=1e-3
        )
        assert_array_equal(
            divided_by_factor(given.T, factor, transposed=False), divided_by_factor(right.T, factor, transposed=False)
        )


def read_only() -> np.ndarray:
    out = positive(3)
    out.flags.writeable = False
    return out


@pytest.mark.parametrize(
    "matrix",
    [
        np.ones((2, 3), order="F"),
        np.ones(4),
        np.ascontiguousarray(positive(3) + np.arange(9.0).reshape(3, 3)),
        positive(3).astype(np.float32),
        positive(6)[::2, ::2],
        read_only(),
    ],
)
def test_what_does_not_lie_as_lapack_takes_it_is_refused(matrix):
    with pytest.raises(ValueError, match="expected"):
        cholesky_in_place(matrix)
    with pytest.raises(ValueError, match="expected"):
        solve_by_factor(matrix, np.ones((3, 1)))
    with pytest.raises(ValueError, match="expected"):
        divided_by_factor(np.ones((1, 3)), matrix, transposed=True)


def test_right_sides_of_another_matrix_are_refused():
    factor = positive(3)
    with pytest.raises(ValueError, match=r"expected \(3, c\)"):
        solve_by_factor(factor, np.ones((4, 2)))
    with pytest.raises(ValueError, match=r"expected \(m, 3\)"):
        divided_by_factor(np.ones((2, 4)), factor, transposed=False)
