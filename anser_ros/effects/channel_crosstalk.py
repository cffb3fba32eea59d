"""Channels leak into each other, inside a cluster or between two of them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    sigmas,
    unit_matrix,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord

MOST_PAIRS = 300
"""Pairs of channels that are tried at most, those of the lowest numbers: all pairs of 25 channels.
Each is a linear fit; 48 channels would have a thousand, for a fault that is rare in any one."""


def _pairs(count: int) -> list[tuple[int, int]]:
    """Places of the off-diagonal entries, row by row."""
    return [(i, j) for i in range(count) for j in range(count) if i != j]


class ChannelCrosstalk(Effect[Term]):
    """Theta is the off-diagonal entries of M, row by row; readings are M times the true ones."""

    name = 'channel_crosstalk'
    summary = 'channels leak into each other'
    units = {'channels': '1', 'matrix': '1'}
    plausible = {'matrix': (-0.5, 0.5)}
    remedy = Remedy.FLUX

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try clusters as a whole, and pairs of channels of different clusters."""
        groups = [g for g in apparatus.clusters() if len(g) <= 4]
        inside = {pair for g in groups if len(g) > 2 for pair in combinations(sorted(g), 2)}
        pairs = [p for p in combinations(sorted(apparatus.tool_channels), 2) if p not in inside]
        groups += [p for p in pairs if p not in groups][:MOST_PAIRS]
        return [Term(self, {'channels': g}, np.zeros(len(g) * (len(g) - 1))) for g in groups]

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 0.1: leaks amount to some percent."""
        return np.full(term.theta.size, 0.1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the other channels' fluxes, which leak into each channel."""
        rows = [view.row(c) for c in term.site['channels']]
        if all(row is None for row in rows):
            return None
        size = len(rows)
        known = [i for i, row in enumerate(rows) if row is not None]
        here = np.array([row for row in rows if row is not None])
        matrix = self._matrix(term)[np.ix_(known, known)]
        own = np.linalg.solve(matrix, view.linear[:, here])
        out = view.columns(term.theta.size)
        for column, (i, j) in enumerate(_pairs(size)):
            if i in known and j in known:
                out[:, rows[i], :, column] = own[:, known.index(j)]
        return out

    def _matrix(self, term: Term) -> Array:
        size = len(term.site['channels'])
        matrix = np.eye(size)
        for value, place in zip(term.theta, _pairs(size), strict=True):
            matrix[place] = value
        return matrix

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Mix the cluster's channels; one that is not there leaks nothing."""
        matrix, block = unit_matrix(channels.size), self._matrix(term)
        place = {int(c): row for row, c in enumerate(channels)}
        for i, to in enumerate(term.site['channels']):
            for j, source in enumerate(term.site['channels']):
                if to in place and source in place:
                    matrix[place[to], place[source]] = block[i, j]
        return matrix

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the whole matrix, ones on its diagonal."""
        size = len(term.site['channels'])
        sigma = np.zeros((size, size))
        for value, place in zip(sigmas(covariance), _pairs(size), strict=True):
            sigma[place] = value
        return EffectRecord(
            self.name,
            {'channels': list(term.site['channels']), 'matrix': self._matrix(term).tolist()},
            {'matrix': sigma.tolist()},
        )

    def possible(self, record: EffectRecord) -> bool:
        """Return whether the leaks, the matrix less its diagonal of ones, are in their range."""
        leaks = np.asarray(record.parameters['matrix'], dtype=np.float64)
        leaks = leaks - np.eye(len(leaks))
        return super().possible(replace(record, parameters={'matrix': leaks}))

    def term(self, record: EffectRecord) -> Term:
        """Read the leaks from a record's matrix, whose diagonal is scaled to one."""
        channels = whole_numbers(record, 'channels')
        matrix = np.asarray(needed(record, 'matrix'), dtype=np.float64)
        if matrix.shape != (len(channels), len(channels)):
            raise ModelFileError(
                f'model: channel_crosstalk of {len(channels)} channels has a matrix {matrix.shape}'
            )
        matrix = matrix / np.diag(matrix)[:, None]
        theta = np.array([matrix[place] for place in _pairs(len(channels))])
        return Term(self, {'channels': channels}, theta)


EFFECTS = (ChannelCrosstalk(),)
