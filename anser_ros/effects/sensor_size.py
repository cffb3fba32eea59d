"""The tool's coils are too long to be points."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from anser_ros.effects.effect import (
    Apparatus,
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    View,
    needed,
)  # fmt: skip
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable

UNIT = 1e-4
"""theta counts squared lengths in units of (10 mm)^2."""


class SensorSize(Effect):
    """theta: length squared over (10 mm)^2, of all coils of a body.

    The mean field over a coil of length L differs from its centre's by L^2/24 times the second
    derivative along the coil, so the effect is linear in L^2.
    """

    name = 'sensor_size'
    summary = 'the coils are too long to be points'
    units: ClassVar[Mapping[str, str]] = {'length_m': 'm', 'channels': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'length_m': (0.0, 0.08)}
    remedy = Remedy.SENSORS

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """All coils of a body together."""
        return [
            Term(
                self,
                {
                    'body': table.body[0],
                    '_channels': tuple(int(c) for c in table.channel),
                    '_lengths': tuple(float(v) for v in table.length),
                },
                np.zeros(1),
            )
            for table in apparatus.tools
            if len(table)
        ]

    def prior(self, term: Term) -> Array:
        """Lengths of a few centimetres."""
        return np.full(1, 10.0)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Difference between the flux of a longer coil and the coil as it is."""
        rows = np.isin(view.sensors.channel, term.site['_channels'])
        if view.is_reference or not rows.any():
            return None
        centres, axes, lengths = view.flat
        longer = np.sqrt(lengths**2 + UNIT)
        pick = np.tile(rows, view.time.size)
        difference = np.zeros((centres.shape[0], view.omega.size), dtype=complex)
        difference[pick] = view.dipoles.flux(
            centres[pick], axes[pick], longer[pick]
        ) - view.dipoles.flux(centres[pick], axes[pick], lengths[pick])
        return view.along(difference)[..., None]

    def bounded(self, term: Term) -> Term:
        """A squared length is not negative where that can be helped: the sum must not be."""
        smallest = -min(v**2 for v in term.site['_lengths']) / UNIT
        return term.with_theta(np.maximum(term.theta, smallest))

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        """Longer sensors."""
        length = sensors.length.copy()
        surveyed = dict(zip(term.site['_channels'], term.site['_lengths'], strict=True))
        for row, channel in enumerate(sensors.channel.tolist()):
            if channel in surveyed:
                squared = surveyed[channel] ** 2 + UNIT * term.theta[0]
                length[row] = np.sqrt(max(squared, 0.0))
        return sensors.with_geometry(length=length)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The length (root mean square over the coils)."""
        base = float(np.mean(np.square(term.site['_lengths'])))
        length = float(np.sqrt(max(base + UNIT * term.theta[0], 0.0)))
        sigma = UNIT * float(np.sqrt(covariance[0, 0])) / (2 * max(length, 1e-4))
        return EffectRecord(
            self.name,
            {
                'length_m': length,
                'channels': list(term.site['_channels']),
                'surveyed_length_m': list(term.site['_lengths']),
            },
            {'length_m': sigma},
        )

    def term(self, record: EffectRecord) -> Term:
        """From the length."""
        channels = tuple(int(c) for c in needed(record, 'channels'))
        surveyed = record.parameters.get('surveyed_length_m') or [0.0] * len(channels)
        base = float(np.mean(np.square(surveyed)))
        theta = (float(needed(record, 'length_m')) ** 2 - base) / UNIT
        site = {'_channels': channels, '_lengths': tuple(float(v) for v in surveyed)}
        return Term(self, site, np.array([theta]))


EFFECTS = (SensorSize(),)
