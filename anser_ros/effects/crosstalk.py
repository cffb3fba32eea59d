"""Channels or emitters' tones leak into each other, or a constant phasor is added to a channel."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Site,
    Term,
    complex_of,
    needed,
    pairs_of,
    recorded_site,
    sigmas,
    unit_matrix,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord

MOST_PAIRS = 300
"""Pairs of channels that are tried at most, those of the lowest numbers: all of 25 channels."""


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
    typical = 0.1  # leaks amount to some percent

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try clusters as a whole, and pairs of channels of different clusters."""
        groups = [g for g in apparatus.clusters() if len(g) <= 4]
        inside = {pair for g in groups if len(g) > 2 for pair in combinations(sorted(g), 2)}
        pairs = [p for p in combinations(sorted(apparatus.tool_channels), 2) if p not in inside]
        groups += [p for p in pairs if p not in groups][:MOST_PAIRS]
        return [Term(self, {'channels': g}, np.zeros(len(g) * (len(g) - 1))) for g in groups]

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
        matrix = self._matrix(term)
        sigma = self._matrix(term.with_theta(sigmas(covariance))) - np.eye(len(matrix))
        parameters = {**recorded_site(term), 'matrix': matrix.tolist()}
        return EffectRecord(self.name, parameters, {'matrix': sigma.tolist()})

    def possible(self, record: EffectRecord) -> bool:
        """Return whether the leaks, the matrix less its diagonal of ones, are in their range."""
        leaks = np.asarray(record.parameters['matrix'], dtype=np.float64)
        leaks = leaks - np.eye(len(leaks))
        return super().possible(replace(record, parameters={'matrix': leaks}))

    def term(self, record: EffectRecord) -> Term:
        """Read the leaks from a record's matrix, whose diagonal is scaled to one."""
        site = self.site_of(record)
        count = len(site['channels'])
        matrix = np.asarray(needed(record, 'matrix'), dtype=np.float64)
        if matrix.shape != (count, count):
            raise ModelFileError(
                f'model: channel_crosstalk of {count} channels has a matrix {matrix.shape}'
            )
        matrix = matrix / np.diag(matrix)[:, None]
        return Term(self, site, np.array([matrix[place] for place in _pairs(count)]))


class CoilCrosstalk(Effect[Term]):
    """Theta is the real and imaginary share of a one-way leak, or one real share both ways.

    Readings at the second coil's frequency contain a share of the first one's field.
    """

    name = 'coil_crosstalk'
    summary = "one emitter's tone leaks into another's"
    units = {'coils': '1', 'eps': '1', 'eps_quadrature': '1', 'mutual': '1'}
    plausible = {'eps': (-0.5, 0.5)}
    remedy = Remedy.FLUX
    typical = 0.1  # leaks amount to some percent

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try every ordered pair, and every pair both ways."""
        coils = range(apparatus.emitters)
        one_way: list[Site] = [{'coils': p} for p in permutations(coils, 2)]
        both: list[Site] = [{'coils': p, 'mutual': True} for p in combinations(coils, 2)]
        return [
            Term(self, site, np.zeros(1 if 'mutual' in site else 2)) for site in one_way + both
        ]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the source emitter's flux, placed in the other emitter's tone."""
        source, target = term.site['coils']
        back = np.linalg.inv(self._matrix(term, view.omega.size))
        own = np.einsum('ab,fsb->fsa', back, view.linear)
        out = view.columns(term.theta.size)
        out[:, :, target, 0] = own[:, :, source]
        if term.site.get('mutual'):
            out[:, :, source, 0] = own[:, :, target]
        else:
            out[:, :, target, 1] = 1j * own[:, :, source]
        return out

    def _matrix(self, term: Term, emitters: int) -> ComplexArray:
        source, target = term.site['coils']
        matrix = unit_matrix(emitters)
        if term.site.get('mutual'):
            matrix[target, source] = matrix[source, target] = term.theta[0]
        else:
            matrix[target, source] = complex(*term.theta)
        return matrix

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return the unit matrix with one entry more, or two."""
        return self._matrix(term, omega.size)[None]

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the source, the target and the share that leaks, with its uncertainty."""
        keys = ('eps', 'eps_quadrature')[: term.theta.size]
        parameters = {**recorded_site(term), **dict(zip(keys, term.theta.tolist(), strict=True))}
        sigma = sigmas(covariance).tolist()
        return EffectRecord(self.name, parameters, dict(zip(keys, sigma, strict=True)))

    def term(self, record: EffectRecord) -> Term:
        """Read the source, the target and the share that leaks from a record."""
        site, eps = self.site_of(record), float(needed(record, 'eps'))
        if record.parameters.get('mutual'):
            return Term(self, {**site, 'mutual': True}, np.array([eps]))
        across = float(record.parameters.get('eps_quadrature', 0.0))
        return Term(self, site, np.array([eps, across]))


UNIT = 1e-9
"""theta counts nanotesla."""


class Pickup(Effect[Term]):
    """Theta is the real, then the imaginary parts of one channel's phasors, nT."""

    name = 'pickup'
    summary = 'a constant phasor is added to a channel'
    units = {'channel': '1', 'phasor_t': 'T (re, im of every emitter)', 'rms_t': 'T'}
    plausible = {'rms_t': (0.0, 1e-6)}
    remedy = Remedy.FLUX
    typical = 30.0  # phasors are some tens of nanotesla

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every channel of a tool."""
        return self._at(apparatus.tool_channels, apparatus)

    def _at(self, channels: Sequence[int], apparatus: Apparatus) -> list[Term]:
        return [Term(self, {'channel': c}, np.zeros(2 * apparatus.emitters)) for c in channels]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return a constant column for either part of every emitter's phasor."""
        row = view.row(term.site['channel'])
        if row is None:
            return None
        emitters = view.omega.size
        out = view.columns(2 * emitters)
        for k in range(emitters):
            out[:, row, k, k], out[:, row, k, emitters + k] = UNIT, 1j * UNIT
        return out

    def offset(self, term: Term, channels: NDArray[np.int64], emitters: int) -> ComplexArray:
        """Return the flux offset of all channels, with the phasor, T, in its channel's row."""
        out = np.zeros((channels.size, emitters), dtype=complex)
        out[channels == term.site['channel']] = complex_of(term.theta * UNIT)
        return out

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the phasors of a channel and their root mean square, T."""
        phasor, sigma = complex_of(term.theta * UNIT), sigmas(covariance).reshape(2, -1) * UNIT
        rms = float(np.sqrt(np.mean(np.abs(phasor) ** 2)))
        return EffectRecord(
            self.name,
            {**recorded_site(term), 'phasor_t': pairs_of(phasor), 'rms_t': rms},
            {'phasor_t': sigma.T.tolist(), 'rms_t': float(np.sqrt(np.mean(sigma**2)))},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read a channel and its phasors, T, from a record."""
        parts = np.asarray(needed(record, 'phasor_t'), dtype=np.float64)
        return Term(self, self.site_of(record), parts.T.ravel() / UNIT)


class ReferenceChanged(Pickup):
    """Acts as `Pickup` on a reference sensor, which rests: any lasting change is a constant."""

    name = 'reference_changed'
    summary = (
        "a reference sensor's reading changed permanently: it was moved or turned, or picks up "
        'interference'
    )

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every channel of a reference sensor."""
        ours = apparatus.tool_channels
        return self._at([c for c in apparatus.channels if c not in ours], apparatus)


EFFECTS = (
    ChannelCrosstalk(),
    CoilCrosstalk(),
    Pickup(),
    ReferenceChanged(),
)
