"""A constant phasor is added to a channel: cables, or drive that couples into sense."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, needed, sigmas
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord

UNIT = 1e-9
"""theta counts nanotesla."""


class Pickup(Effect[Term]):
    """Theta is the real, then the imaginary parts of one channel's phasors, nT."""

    name = 'pickup'
    summary = 'a constant phasor is added to a channel'
    units = {
        'channel': '1',
        'phasor_t': 'T (re, im of every emitter)',
        'rms_t': 'T',
    }
    plausible = {'rms_t': (0.0, 1e-6)}
    remedy = Remedy.FLUX

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every channel of a tool."""
        return [self._at(c, apparatus) for c in apparatus.tool_channels]

    def _at(self, channel: int, apparatus: Apparatus) -> Term:
        return Term(self, {'channel': channel}, np.zeros(2 * apparatus.emitters))

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 30 nT: phasors are some tens of nanotesla."""
        return np.full(term.theta.size, 30.0)

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

    def _phasor(self, term: Term) -> ComplexArray:
        parts = term.theta.reshape(2, -1) * UNIT
        return np.asarray(parts[0] + 1j * parts[1])

    def offset(self, term: Term, channels: NDArray[np.int64], emitters: int) -> ComplexArray:
        """Return the flux offset of all channels, with the phasor, T, in its channel's row."""
        out = np.zeros((channels.size, emitters), dtype=complex)
        out[channels == term.site['channel']] = self._phasor(term)
        return out

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the phasors of a channel and their root mean square, T."""
        phasor, sigma = self._phasor(term), sigmas(covariance).reshape(2, -1) * UNIT
        rms = float(np.sqrt(np.mean(np.abs(phasor) ** 2)))
        return EffectRecord(
            self.name,
            {
                'channel': term.site['channel'],
                'phasor_t': [[float(p.real), float(p.imag)] for p in phasor],
                'rms_t': rms,
            },
            {'phasor_t': sigma.T.tolist(), 'rms_t': float(np.sqrt(np.mean(sigma**2)))},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read a channel and its phasors, T, from a record."""
        parts = np.asarray(needed(record, 'phasor_t'), dtype=np.float64)
        return Term(self, {'channel': int(needed(record, 'channel'))}, parts.T.ravel() / UNIT)


class ReferenceChanged(Pickup):
    """Acts as `Pickup` on a reference sensor, which rests: any lasting change is a constant."""

    name = 'reference_changed'
    summary = (
        "a reference sensor's reading changed permanently: it was moved or turned, or picks up "
        'interference'
    )

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every channel of a reference sensor."""
        return [
            self._at(c, apparatus) for c in apparatus.channels if c not in apparatus.tool_channels
        ]


EFFECTS = (Pickup(), ReferenceChanged())
