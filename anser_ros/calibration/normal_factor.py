"""Factors the large matrices of normal equations, in strips that threads share.

The strips are the same for any number of threads, and so are the results, bit by bit, which they
are not when the threads of a BLAS divide one product among them. The factor is Cholesky's,
worked out by blocks (Golub and Van Loan, Matrix Computations, section 4.2.9).
"""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from anser_ros.parallel import in_order, slices

Array = NDArray[np.float64]

STRIP = 256
"""Columns of a strip: fewer make products that are slow for their size, more leave threads without
work at the end of a matrix of some thousand columns."""


def subtract_gram(out: Array, rows: Array) -> None:
    """Subtract the products of all pairs of columns from the upper triangle of a matrix.

    ``out`` (N, N): changed from the diagonal on, and below it inside the blocks on the diagonal.
    ``rows`` (R, N).
    """

    def work(own: slice) -> None:
        out[own, own.start :] -= rows[:, own].T @ rows[:, own.start :]

    in_order(work, slices(len(out), STRIP))


class NormalFactor:
    """Holds the upper factor U of a positive definite matrix ``U^T U``.

    ``matrix`` (N, N): of which only the upper triangle is read; the factor takes its place.
    Raises `numpy.linalg.LinAlgError` when it is not positive definite.
    """

    def __init__(self, matrix: Array) -> None:
        self._factor = left = matrix
        self._strips = slices(len(matrix), STRIP)
        self._inverses: list[Array] = []
        for at, own in enumerate(self._strips):

            def reduce(other: slice, own: slice = own) -> None:
                left[own, other] -= left[: own.start, own].T @ left[: own.start, other]

            in_order(reduce, self._strips[at:])
            corner = left[own, own]
            corner[:] = np.linalg.cholesky(corner.T).T  # which reads the lower triangle only
            inverse = _inverse_of_upper(corner).T

            def divide(other: slice, own: slice = own, inverse: Array = inverse) -> None:
                left[own, other] = inverse @ left[own, other]

            in_order(divide, self._strips[at + 1 :])
            self._inverses.append(inverse)

    def solve(self, right: Array) -> Array:
        """Return the solution X (N, Q) of ``matrix X = right``."""
        factor, out = self._factor, right.copy()
        pairs = list(zip(self._strips, self._inverses, strict=True))
        for own, inverse in pairs:
            out[own] = inverse @ (out[own] - factor[: own.start, own].T @ out[: own.start])
        for own, inverse in reversed(pairs):
            out[own] = inverse.T @ (out[own] - factor[own, own.stop :] @ out[own.stop :])
        return out

    def inverse_diagonal(self) -> Array:
        """Return the diagonal of the matrix's inverse, shape (N,)."""
        factor, strips, inverses = self._factor, self._strips, self._inverses

        def work(first: int) -> Array:
            """Sums of squares of the columns of the factor's inverse, transposed, in a strip."""
            begin = strips[first].start
            columns = np.zeros((len(factor) - begin, len(inverses[first])))
            columns[: len(inverses[first])] = inverses[first]
            for own, inverse in zip(strips[first + 1 :], inverses[first + 1 :], strict=True):
                above = columns[: own.start - begin]
                product = factor[begin : own.start, own].T @ above
                columns[own.start - begin : own.stop - begin] = -inverse @ product
            return np.asarray(np.einsum('ij,ij->j', columns, columns))

        return np.concatenate(in_order(work, range(len(strips))))


def _inverse_of_upper(factor: Array) -> Array:
    return np.asarray(scipy.linalg.solve_triangular(factor, np.eye(len(factor))))
