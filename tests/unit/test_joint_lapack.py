"""The functions of LAPACK and BLAS that give Python's lock away, beside those of SciPy that keep it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.linalg import blas, lapack

from sfm_audit.audit.joint.lapack import (
    add_both,
    add_product,
    add_square,
    cholesky_in_place,
    divide,
    inverse_of_factor,
    invert_triangle,
    mirror,
    multiply,
    solve_by_factor,
    square_triangle,
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
        return
    assert_array_equal(solve_by_factor(factor, right), lapack.dpotrs(expected, right, lower=1)[0])
    inverse = inverse_of_factor(factor)
    assert_array_equal(np.tril(inverse), np.tril(lapack.dpotri(expected, lower=1)[0]))
    np.testing.assert_allclose((np.tril(inverse) + np.tril(inverse, -1).T) @ matrix, np.eye(size), atol=1e-6)
    divided = np.array(right.T, order="F")
    divide(divided, factor)
    assert_array_equal(divided, blas.dtrsm(1.0, expected, right.T, side=1, lower=1, trans_a=1))
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
        square_triangle(matrix)


def test_right_sides_of_another_matrix_are_refused():
    with pytest.raises(ValueError, match=r"expected \(3, c\)"):
        solve_by_factor(positive(3), np.ones((4, 2)))


def in_each_order(matrix):
    """The same numbers in C and in Fortran order, and as a part of something larger in either."""
    rows, columns = matrix.shape
    larger = np.zeros((rows + 3, columns + 2))
    parts = larger[1 : rows + 1, 2:], np.asfortranarray(larger)[1 : rows + 1, 2:]
    for part in parts:
        part[...] = matrix
    return matrix.copy(), matrix.copy(order="F"), *parts


def lower_of(size):
    root = np.random.default_rng(size).normal(size=(size, size)) / max(size, 1) ** 0.5
    return np.asfortranarray(np.tril(root) + 2.0 * np.eye(size))


@pytest.mark.parametrize("shape", [(3, 5), (1, 4), (4, 1), (1, 1), (0, 3), (3, 0)])
def test_triangles_divide_and_multiply_in_place_however_rows_lie(shape):
    matrix, lower = np.random.default_rng(3).normal(size=shape), lower_of(shape[1])
    kept = lower.copy()
    for function, other in ((divide, np.linalg.inv(lower).T), (multiply, lower)):
        for given in in_each_order(matrix):
            function(given, lower)
            np.testing.assert_allclose(given, matrix @ other, rtol=1e-12, atol=1e-13)
    assert_array_equal(lower, kept)


@pytest.mark.parametrize("size", [0, 1, 5, 128, 129, 300])
def test_a_triangle_is_inverted_and_squared_in_place(size):
    lower = np.asfortranarray(lower_of(size) + np.triu(np.full((size, size), 7.0), 1))  # something else stands above
    expected = np.linalg.inv(np.tril(lower))
    for given in (lower.copy(order="F"), in_each_order(lower)[3]):
        invert_triangle(given)
        np.testing.assert_allclose(np.tril(given), expected, rtol=1e-9, atol=1e-12)
        assert (np.triu(given, 1) == np.triu(lower, 1)).all()
    square_triangle(lower)
    np.testing.assert_allclose(lower, np.tril(lower_of(size)).T @ lower_of(size), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [0, 1, 63, 64, 65, 150])
def test_a_mirror_puts_below_above(size):
    matrix = np.random.default_rng(size).normal(size=(size, size))
    for given in in_each_order(matrix):
        mirror(given)
        assert_array_equal(given, np.tril(matrix) + np.tril(matrix, -1).T)


@pytest.mark.parametrize("shape", [(3, 5, 4), (1, 4, 1), (4, 1, 3), (2, 3, 0), (0, 2, 3)])
def test_products_of_matrices_in_any_order_are_added_in_any_order(shape):
    rng, (m, n, k) = np.random.default_rng(4), shape
    left, right, before = rng.normal(size=(m, k)), rng.normal(size=(k, n)), rng.normal(size=(m, n))
    for out, a, b in itertools.product(*map(in_each_order, (before, left, right))):
        out[...] = before
        add_product(out, a, b, -0.5)
        np.testing.assert_allclose(out, before - 0.5 * left @ right, rtol=1e-12, atol=1e-13)
        add_product(out, a, b, 2.0, keep=0.0)
        np.testing.assert_allclose(out, 2.0 * left @ right, rtol=1e-12, atol=1e-13)


def test_what_was_not_a_number_is_gone_where_nothing_of_it_is_kept():
    out = np.full((2, 2), np.nan)
    add_product(out, np.eye(2), np.eye(2), keep=0.0)
    assert_array_equal(out, np.eye(2))
    out = np.full((2, 2), np.nan, order="F")
    add_both(out, np.eye(2), np.eye(2), keep=0.0)
    assert_array_equal(np.tril(out), 2.0 * np.eye(2))


@pytest.mark.parametrize("shape", [(4, 3), (1, 5), (3, 1), (3, 0), (0, 2)])
def test_symmetric_products_fill_the_lower_triangle(shape):
    rng = np.random.default_rng(5)
    left, right, before = rng.normal(size=shape), rng.normal(size=shape), rng.normal(size=(shape[0], shape[0]))
    for out, a, b in zip(in_each_order(before)[1::2], in_each_order(left), in_each_order(right), strict=False):
        add_square(out, a, -2.0)
        np.testing.assert_allclose(np.tril(out), np.tril(before - 2.0 * left @ left.T), rtol=1e-12, atol=1e-13)
        assert_array_equal(np.triu(out, 1), np.triu(before, 1))
        add_both(out, a, b, 0.5, keep=0.0)
        np.testing.assert_allclose(np.tril(out), 0.5 * np.tril(left @ right.T + right @ left.T), rtol=1e-12, atol=1e-13)


def test_matrices_that_do_not_fit_are_refused():
    square, wide = np.eye(3, order="F"), np.ones((2, 3))
    for wrong in (
        lambda: divide(wide.T, square),
        lambda: multiply(wide, np.ones((3, 3)) + np.arange(3.0)),
        lambda: invert_triangle(np.ones((3, 3))),
        lambda: invert_triangle(np.ones((2, 3), order="F")),
        lambda: add_product(square, wide, square),
        lambda: add_product(wide, wide, wide.T),
        lambda: add_product(square, square.astype(np.float32), square),
        lambda: add_product(square, np.ones((6, 6))[::2, ::2], square),
        lambda: add_product(read_only(), square, square),
        lambda: add_square(square, wide),
        lambda: add_square(np.ones((2, 2)), wide),
        lambda: add_both(square, wide, wide),
        lambda: add_both(np.asfortranarray(np.ones((2, 2))), wide, np.asfortranarray(wide)),
        lambda: add_both(np.ones((2, 2)), wide, wide),
    ):
        with pytest.raises(ValueError, match="expected"):
            wrong()
