"""A constant phasor is added to a channel: cables, or drive that couples into sense."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    complex_of,
    needed,
    pairs_of,
    recorded_site,
    sigmas,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord

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


EFFECTS = (Pickup(), ReferenceChanged())
