"""Solves least squares: many rows by one small kept factor, large normal matrices.

`TriangularFactor` and `GramFactor` keep a problem of any number of rows as one small matrix, whose
`Spectrum` gives the solution for every damping. `NormalFactor` factors the matrix of a joint
system, which `subtract_gram` sums in strips that threads share. The strips are the same for any
number of threads, and so are the results, bit by bit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from anser_ros.arrays import Array, Integers
from anser_ros.parallel import in_order, slices

RIGHT_SCALE = 1e9
"""Factor of the right-hand sides in a Gram matrix: fluxes are then of a size with the columns."""


class TriangularFactor:
    """Keeps a least-squares problem as the triangular factor of its rows, by QR, in blocks."""

    def __init__(self, unknowns: int, right_sides: int) -> None:
        self.unknowns, self.right_sides = unknowns, right_sides
        self.triangle = np.zeros((0, unknowns + right_sides))

    def add(self, matrix: Array, right: Array) -> None:
        """Take in rows (P, N) with their right-hand sides (P, M)."""
        stack = np.concatenate([self.triangle, np.concatenate([matrix, right], axis=1)])
        self.triangle = np.asarray(np.linalg.qr(stack, mode='r'))

    def spectrum(self, some: Integers | None = None) -> 'Spectrum':
        """Return the singular value decomposition of the column-scaled problem.

        ``some``: the unknowns that there are; all by default.
        """
        n = self.unknowns
        matrix, right = self.triangle[:n, :n], self.triangle[:n, n:]
        matrix = matrix if some is None else matrix[:, some]
        scale = np.linalg.norm(matrix, axis=0)
        scale[scale == 0.0] = 1.0
        u, s, vt = np.linalg.svd(matrix / scale, full_matrices=False)
        return Spectrum(scale, s, vt, u.T @ right)


class GramFactor:
    """Keeps the same problem as the inner products of its columns.

    It is several times faster and has half the digits of a `TriangularFactor`: enough for rounds
    that only prepare the next one, and for dampings far above the rounding.
    """

    def __init__(self, unknowns: int, right_sides: int) -> None:
        self.unknowns, self.right_sides = unknowns, right_sides
        self.gram = np.zeros((unknowns + right_sides, unknowns + right_sides))

    def add(self, matrix: Array, right: Array) -> None:
        """Take in rows (P, N) with their right-hand sides (P, M)."""
        block = np.concatenate([matrix, right * RIGHT_SCALE], axis=1)
        self.gram += block.T @ block

    def spectrum(self, some: Integers | None = None) -> 'Spectrum':
        """Return the same by eigenvectors."""
        rows = np.arange(self.unknowns) if some is None else some
        n, total = rows.size, self.unknowns
        scale = np.sqrt(np.diag(self.gram)[rows])
        scale[scale == 0.0] = 1.0
        inner = self.gram[np.ix_(rows, rows)]
        values, vectors = np.linalg.eigh(inner / np.outer(scale, scale))
        floor = values[-1] * np.finfo(float).eps * n
        s = np.sqrt(np.maximum(values, floor))[::-1]
        v = vectors[:, ::-1].T
        right = self.gram[rows, total:] / (scale[:, None] * RIGHT_SCALE)
        return Spectrum(scale, s, v, (v @ right) / s[:, None])


@dataclass(frozen=True)
class Spectrum:
    """Keeps a least-squares problem in its singular vectors, which make every damping cheap."""

    scale: Array  # (N,): norms by which the columns were divided
    values: Array  # (R,): singular values of the scaled matrix, descending
    vectors: Array  # (R, N): right singular vectors
    projected: Array  # (R, M): right-hand sides in the left singular vectors

    @property
    def rank(self) -> int:
        """Return the number of singular values above the rounding error."""
        limit = self.values[0] * np.finfo(float).eps * max(self.vectors.shape)
        return int((self.values > limit).sum())

    def filter(self, damping: float) -> Array:
        """Return Tikhonov's factors ``s / (s^2 + (damping s_0)^2)``, zero beyond the rank."""
        s = self.values
        out = np.zeros_like(s)
        keep = np.arange(s.size) < self.rank
        out[keep] = s[keep] / (s[keep] ** 2 + (damping * s[0]) ** 2)
        return out

    def solve(self, damping: float, prior: Array | None = None) -> Array:
        """Return the unknowns (N, M), which the damping pulls towards ``prior`` (N, M) or zero."""
        projected = self.projected
        if prior is not None:
            start = self.vectors @ (prior * self.scale[:, None])
            projected = projected - self.values[:, None] * start
        step = self.vectors.T @ (self.filter(damping)[:, None] * projected)
        step /= self.scale[:, None]
        return np.asarray(step if prior is None else prior + step)

    def freedom(self, damping: float) -> float:
        """Return the effective number of parameters, the trace of the influence matrix."""
        return float((self.values * self.filter(damping)).sum())


STRIP = 256
"""Columns of a strip: fewer make slow products, more leave threads without work at the end."""


def subtract_gram(out: Array, rows: Array) -> None:
    """Subtract the products of all pairs of columns from the upper triangle of a matrix.

    ``out`` (N, N): changed from the diagonal on, and below it inside the blocks on the diagonal.
    ``rows`` (R, N).
    """

    def work(own: slice) -> None:
        out[own, own.start :] -= rows[:, own].T @ rows[:, own.start :]

    in_order(work, slices(len(out), STRIP))


class NormalFactor:
    """Holds Cholesky's factor of a positive definite matrix.

    ``matrix`` (N, N): of which only the upper triangle is read; the factor takes its place.
    Raises `numpy.linalg.LinAlgError` when it is not positive definite.
    """

    def __init__(self, matrix: Array) -> None:
        # LAPACK has columns for rows.
        self._factor = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, right: Array) -> Array:
        """Return the solution X (N, Q) of ``matrix X = right``."""
        return np.asarray(cho_solve(self._factor, right, check_finite=False))

    def inverse_diagonal(self) -> Array:
        """Return the diagonal of the matrix's inverse, shape (N,); it takes the factor's place."""
        return np.diag(dpotri(self._factor[0], lower=1, overwrite_c=1)[0])
