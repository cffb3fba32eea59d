"""The tool's coils are too long to be points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable

UNIT = 1e-4
"""theta counts squared lengths in units of (10 mm)^2."""


@dataclass(frozen=True, kw_only=True)
class SensorSizeTerm(Term):
    """Holds the coils of one body."""

    surveyed: Mapping[int, float]  # Surveyed length (m) of the coil on each channel


class SensorSize(Effect[SensorSizeTerm]):
    """Theta is what the squared length of a body's coils grows by, in (10 mm)^2.

    The mean field over a coil of length L differs from its centre's by L^2/24 times the second
    derivative along the coil, so the effect is linear in L^2.
    """

    name = 'sensor_size'
    summary = 'the coils are too long to be points'
    units = {'length_m': 'm', 'channels': '1'}
    plausible = {'length_m': (0.0, 0.08)}
    remedy = Remedy.SENSORS

    def candidates(self, apparatus: Apparatus) -> Sequence[SensorSizeTerm]:
        """Return a candidate for all coils of each body that has sensors."""
        return [
            SensorSizeTerm(
                self,
                {'body': table.body[0]},
                np.zeros(1),
                surveyed=dict(zip(table.channel.tolist(), table.length.tolist(), strict=True)),
            )
            for table in apparatus.tools
            if len(table)
        ]

    def prior(self, term: SensorSizeTerm) -> Array:
        """Return a prior spread that allows coil lengths of a few centimetres."""
        return np.full(1, 10.0)

    def columns(self, term: SensorSizeTerm, view: View) -> ComplexArray | None:
        """Return the difference between the flux of a longer coil and the coil as it is."""
        rows = np.isin(view.sensors.channel, list(term.surveyed))
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

    def bounded(self, term: SensorSizeTerm) -> SensorSizeTerm:
        """Keep the squared length of every coil from becoming negative."""
        smallest = -min(v**2 for v in term.surveyed.values()) / UNIT
        return term.with_theta(np.maximum(term.theta, smallest))

    def table(self, term: SensorSizeTerm, sensors: SensorTable) -> SensorTable:
        """Return the table with the coils at their fitted lengths, m."""
        length = sensors.length.copy()
        for row, channel in enumerate(sensors.channel.tolist()):
            if channel in term.surveyed:
                squared = term.surveyed[channel] ** 2 + UNIT * term.theta[0]
                length[row] = np.sqrt(max(squared, 0.0))
        return sensors.with_geometry(length=length)

    def record(self, term: SensorSizeTerm, covariance: Array) -> EffectRecord:
        """Record the length (root mean square over the coils)."""
        base = float(np.mean(np.square(list(term.surveyed.values()))))
        length = float(np.sqrt(max(base + UNIT * term.theta[0], 0.0)))
        sigma = UNIT * float(np.sqrt(covariance[0, 0])) / (2 * max(length, 1e-4))
        return EffectRecord(
            self.name,
            {
                'length_m': length,
                'channels': list(term.surveyed),
                'surveyed_length_m': list(term.surveyed.values()),
            },
            {'length_m': sigma},
        )

    def term(self, record: EffectRecord) -> SensorSizeTerm:
        """Read the coils' length from a record."""
        channels = whole_numbers(record, 'channels')
        surveyed = record.parameters.get('surveyed_length_m') or [0.0] * len(channels)
        base = float(np.mean(np.square(surveyed)))
        theta = (float(needed(record, 'length_m')) ** 2 - base) / UNIT
        lengths = dict(zip(channels, (float(v) for v in surveyed), strict=True))
        return SensorSizeTerm(self, {}, np.array([theta]), surveyed=lengths)


EFFECTS = (SensorSize(),)
