"""The factor of normal equations in strips, against scipy's, and for any number of threads."""

import numpy as np
import pytest
import scipy.linalg

from anser_ros.calibration.least_squares import STRIP, NormalFactor, subtract_gram
from anser_ros.parallel import shared_among

SIZES = (1, 7, STRIP, STRIP + 1, 3 * STRIP - 5)


def equations(size):
    rng = np.random.default_rng(size)
    rows = rng.standard_normal((size + 20, size)) * np.logspace(0, -4, size)
    return rows.T @ rows, rng.standard_normal((size, 3))


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize('size', SIZES)
def test_solution_and_diagonal_are_scipy_s(size):
    matrix, right = equations(size)
    factor = NormalFactor(np.triu(matrix))
    inverse = scipy.linalg.inv(matrix)
    assert relative(factor.solve(right), scipy.linalg.solve(matrix, right)) < 1e-6
    np.testing.assert_allclose(factor.inverse_diagonal(), np.diag(inverse), rtol=1e-6)


@pytest.mark.parametrize('size', SIZES)
def test_products_are_subtracted_from_the_upper_triangle(size):
    rows = np.random.default_rng(size).standard_normal((50, size))
    out = np.ones((size, size))
    subtract_gram(out, rows)
    np.testing.assert_allclose(np.triu(out), np.triu(1.0 - rows.T @ rows), atol=1e-12)


def test_threads_change_no_bit():
    matrix, right = equations(SIZES[-1])
    found = []
    for count in (1, 2, 3):
        with shared_among(count):
            out = np.triu(matrix) + 10.0 * np.eye(len(matrix))
            subtract_gram(out, 1e-2 * right.T)
            factor = NormalFactor(out)
            found.append((factor.solve(right), factor.inverse_diagonal()))
    for one in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(one, found[0], strict=True))


def test_a_matrix_that_is_not_positive_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        NormalFactor(np.diag([1.0, -1.0]))
