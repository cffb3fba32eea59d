"""All sensors have errors, each its own: populations of gains, axes and places."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Family,
    Remedy,
    Term,
    needed,
    sigmas,
    unit_matrix,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.rotations import tilted
from anser_ros.physics.sensor import SensorTable, clusters_of

LEAST_SHARED = 0.5
"""Share of the gains' variance in common from which on the channels at one place are one sensor:
coils that are wound one by one have next to none, the axes of a chip nearly all."""


@dataclass(frozen=True, kw_only=True)
class SpreadTerm(Term):
    """Holds a population: theta is the values of its channels, one channel after the other."""

    members: tuple[int, ...]  # Their channels
    spread: float  # Standard deviation of the population, in the values' unit
    # Share of the population's variance that the channels at one place have in common
    shared: float = 0.0
    # Which value each channel has, where several have one: row of the values by member. Empty
    # where each has its own.
    groups: tuple[int, ...] = ()

    @property
    def values(self) -> Array:
        """Return the parameters as a table with a row for each channel."""
        if self.groups:
            return self.theta.reshape(max(self.groups) + 1, -1)[list(self.groups)]
        return self.theta.reshape(len(self.members), -1)

    def of(self, channels: NDArray[np.generic]) -> Array:
        """Return the values of listed channels, a row each; zero for one that is no member."""
        out = np.zeros((len(channels), self.values.shape[1]))
        place = {channel: row for row, channel in enumerate(self.members)}
        for row, channel in enumerate(channels.tolist()):
            if channel in place:
                out[row] = self.values[place[channel]]
        return out


MANY = 12
"""Places of sensors from which on a population is looked for by a diagnosis; of fewer, each sensor
that is off is named by itself."""


class SensorSpread(Effect[SpreadTerm]):
    """Is found by a calibration, which has every channel in many poses; a model carries it.

    A diagnosis estimates which gains the sensors at one place share.
    """

    family = Family.SEEN
    plausible = {'spread': (0.0, 0.3)}
    # the values of a faultless channel; empty where they are zeros, as many as a record has
    faultless: ClassVar[tuple[float, ...]] = ()

    def record(self, term: SpreadTerm, covariance: Array) -> EffectRecord:
        """Record spread, channels, and each channel's values with their uncertainty."""
        sigma = term.with_theta(sigmas(covariance)).values.tolist()
        values = (term.values + (self.faultless or 0.0)).tolist()
        return EffectRecord(
            self.name,
            {
                'spread': term.spread, 'channels': list(term.members), 'values': values,
                'uncertainty': sigma, **({'shared': term.shared} if term.shared else {}),
            },
            {'values': sigma},
        )  # fmt: skip

    def term(self, record: EffectRecord) -> SpreadTerm:
        """Read the channels and their values from a record."""
        channels = self.site_of(record)['channels']
        values = np.asarray(needed(record, 'values'), dtype=np.float64)
        width = len(self.faultless) or (values.shape[1] if values.ndim == 2 else 2)
        if values.shape != (len(channels), width) or len(set(channels)) != len(channels):
            raise ModelFileError(
                f'model: {record.name} needs {width} values for each of its '
                f'{len(channels)} channels, got {values.shape}'
            )
        theta = (values - (self.faultless or 0.0)).ravel()
        spread = float(record.parameters.get('spread', 0.0))
        shared = float(record.parameters.get('shared', 0.0))
        return SpreadTerm(self, {}, theta, members=channels, spread=spread, shared=shared)


class SensorGainSpread(SensorSpread):
    """Values are real part less one and imaginary part of each channel's gain."""

    name = 'sensor_gain_spread'
    summary = 'every channel has a gain of its own'
    family = Family.STEADY
    units = {'spread': '1', 'channels': '1', 'values': '1'}
    remedy = Remedy.FLUX
    typical = 0.05  # gains of a kind are within some percent of each other
    parts = ('in phase', 'quadrature')
    faultless = (1.0, 0.0)

    def candidates(self, apparatus: Apparatus) -> Sequence[SpreadTerm]:
        """Return a term of each body with many sensors; those at one place share a gain."""
        out = []
        for table in apparatus.tools:
            places = clusters_of(table)
            if len(places) < MANY or len(places) == len(table):
                continue
            groups = np.zeros(len(table), dtype=np.int64)
            for number, rows in enumerate(places):
                groups[rows] = number
            out.append(
                SpreadTerm(
                    self, {'body': table.body[0]}, np.zeros(2 * len(places)),
                    members=tuple(table.channel.tolist()), spread=0.0, shared=1.0,
                    groups=tuple(groups.tolist()),
                )
            )  # fmt: skip
        return out

    def columns(self, term: SpreadTerm, view: View) -> ComplexArray | None:
        """Return each place's own fluxes, in phase and turned by a quarter."""
        if not term.groups or view.is_reference:
            return None
        out, found = view.columns(term.theta.size), False
        gains = 1.0 + term.values[:, 0] + 1j * term.values[:, 1]
        for channel, group, gain in zip(term.members, term.groups, gains, strict=True):
            row = view.row(channel)
            if row is not None:
                found = True
                own = view.linear[:, row] / gain
                out[:, row, :, 2 * group], out[:, row, :, 2 * group + 1] = own, 1j * own
        return out if found else None

    def record(self, term: SpreadTerm, covariance: Array) -> EffectRecord:
        """Record it as any population; the spread is that of the gains that were found."""
        width = float(np.std(term.theta[0::2])) if term.groups else term.spread
        return super().record(replace(term, spread=width), covariance)

    def channel_matrix(self, term: SpreadTerm, channels: NDArray[np.int64]) -> ComplexArray | None:
        """Return a diagonal matrix of the channels' complex gains."""
        parts = term.of(channels)
        return np.asarray(unit_matrix(channels.size) + np.diag(parts[:, 0] + 1j * parts[:, 1]))

    def gain_changes(self, term: SpreadTerm, sensors: SensorTable) -> Array | None:
        """Return a change for each place; sensors at one place have their gains in common.

        One session cannot show how far a gain changes until the next. The differences among
        sensors of a kind give the natural size of such a change; the axes of one chip change
        together.
        """
        if term.shared < LEAST_SHARED:
            return None
        members = np.isin(sensors.channel, term.members)
        places = [rows[members[rows]] for rows in clusters_of(sensors)]
        places = [rows for rows in places if rows.size]
        out = np.zeros((len(places), len(sensors)))
        for row, channels in enumerate(places):
            out[row, channels] = np.sqrt(term.shared) * term.spread
        return out


class SensorAxisSpread(SensorSpread):
    """Values are the tilts (rad) of each axis along its two tangents (`physics.rotations`)."""

    name = 'sensor_axis_spread'
    summary = "every sensor's axis is a little off"
    units = {'spread': 'rad', 'channels': '1', 'values': 'rad'}
    remedy = Remedy.SENSORS
    parts = ('first tangent', 'second tangent')
    faultless = (0.0, 0.0)

    def table(self, term: SpreadTerm, sensors: SensorTable) -> SensorTable:
        """Return the table with the sensors' true axes."""
        return sensors.with_geometry(axis=tilted(sensors.axis, term.of(sensors.channel)))


class SensorPlaceSpread(SensorSpread):
    """Values are the shifts (m) of each sensor in its body's frame."""

    name = 'sensor_place_spread'
    summary = 'every sensor sits a little off its surveyed place'
    units = {'spread': 'm', 'channels': '1', 'values': 'm'}
    remedy = Remedy.SENSORS
    parts = ('x', 'y', 'z')
    faultless = (0.0, 0.0, 0.0)

    def table(self, term: SpreadTerm, sensors: SensorTable) -> SensorTable:
        """Return the table with the sensors at their true positions, m."""
        return sensors.with_geometry(position=sensors.position + term.of(sensors.channel))


class SensorPickupSpread(SensorSpread):
    """Values are the real and imaginary part of each emitter's phasor in each channel, T."""

    name = 'sensor_pickup_spread'
    summary = 'a constant phasor of its own is added to every channel'
    units = {'spread': 'T', 'channels': '1', 'values': 'T'}
    plausible = {'spread': (0.0, 1.0)}
    remedy = Remedy.FLUX

    def offset(
        self, term: SpreadTerm, channels: NDArray[np.int64], emitters: int
    ) -> ComplexArray | None:
        """Return the phasors that the term adds, T."""
        parts = term.of(channels)
        return np.asarray(parts[:, 0::2] + 1j * parts[:, 1::2])


EFFECTS = (SensorGainSpread(), SensorAxisSpread(), SensorPlaceSpread(), SensorPickupSpread())
