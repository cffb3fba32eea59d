"""Searches hundreds of places cheaply for the compact bodies that merit a full hypothesis.

A body's readings lie in a few directions of the space of readings. With them alone, and one
variance for the remainder, its evidence costs a hundredth of the full one; the best few places are
then evaluated in full beside the clouds (see `refit.posterior`).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Cloud
from anser_ros.refit.kernels import fill_products, fill_scores
from anser_ros.refit.references import vector_basis

Array = NDArray[np.float64]
Single = NDArray[np.float32]

DIRECTIONS = 16
"""Directions of the space of readings that are looked at for each body."""
COARSE = 7
"""Sources of a body that they are made from: its centre and six around it."""
REMAINDER = 1e-3
"""Variance of a reading that those directions leave, over the mean one."""


def _symmetric() -> Array:
    """Return an orthonormal basis of the symmetric tensors, (6, 3, 3)."""
    out = np.zeros((6, 3, 3))
    for component, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        out[component, i, j] = out[component, j, i] = 1.0 if i == j else np.sqrt(0.5)
    return out


def body_factor(cloud: Cloud, references: SensorTable, excitation: Array) -> Single:
    """Return the readings of a body's coarse sources, a column for each tensor component.

    Of shape (S K, 6 COARSE), scaled so that the readings have a mean variance of 1.
    ``excitation`` (COARSE, K, 3) is the field of the emitters at the first sources, T.
    """
    basis = vector_basis(
        references.position, references.axis, references.length, cloud.positions[:COARSE]
    )
    columns = np.einsum('sma,cab,mkb->skmc', basis, _symmetric(), excitation, optimize=True)
    factor = columns.reshape(len(references) * excitation.shape[1], -1)
    factor /= np.sqrt((factor**2).sum() / len(factor))
    return np.asarray(factor, dtype=np.float32)


@dataclass
class BodySearch:
    """Holds the directions of the bodies' readings for the coils in use.

    Attributes
    ----------
    factors : sequence of ndarray, shape (all readings, c)
        From `body_factor`.
    rows : ndarray of int, shape (n,)
        Readings in use.
    whitening : ndarray, shape (n, n)
        Makes noise and drift of the readings white.
    strengths : ndarray, shape (A,)
        Variances of a reading that the evidence is summed over.
    """

    factors: tuple[Single, ...]
    rows: NDArray[np.int64]
    whitening: Array
    strengths: Array
    _tables: dict[float, tuple[Single, Array, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = min(DIRECTIONS, self.factors[0].shape[1], len(self.rows))
        stacked = np.empty((len(self.factors), count, len(self.rows)), dtype=np.float32)
        self._power = np.empty((len(self.factors), count))
        white = self._white = np.ascontiguousarray(self.whitening.T, dtype=np.float32)
        for body, factor in enumerate(self.factors):
            seen = white @ factor[self.rows]
            values, vectors = np.linalg.eigh(seen.T @ seen)
            top = np.maximum(values[::-1][:count], 1e-12 * values[-1])
            stacked[body] = (seen @ (vectors[:, ::-1][:, :count] / np.sqrt(top))).T
            self._power[body] = top
        self._directions = stacked.reshape(-1, len(self.rows))
        self._left = REMAINDER * float(np.mean((white**2).sum(axis=1)))

    def _table(self, noise: float) -> tuple[Single, Array, Array]:
        """Return precisions (L, A, r), those (A,) of the rest, and log determinants (L, A)."""
        if noise not in self._tables:
            self._tables.clear()
            rest = self.strengths * self._left + noise**2
            inside = self.strengths[:, None] * self._power[:, None, :] + rest[:, None]
            others = len(self.rows) - inside.shape[2]
            log_det = np.log(inside).sum(axis=2) + others * np.log(rest)
            self._tables[noise] = ((1.0 / inside).astype(np.float32), 1.0 / rest, log_det)
        return self._tables[noise]

    def scores(self, readings: Array, noise: float) -> Array:
        """Return the approximate log evidence of every body, (L,); arguments as in
        `Bank.evaluate`.
        """
        inside, rest, log_det = self._table(noise)
        white = np.empty((len(self.rows), 2), dtype=np.float32)
        fill_products(self._white, np.ascontiguousarray(readings.T, dtype=np.float32), white)
        white = np.ascontiguousarray(white.T)
        scores = np.empty(len(self._power))
        fill_scores(self._directions, white, inside, rest, log_det, scores)
        return scores
