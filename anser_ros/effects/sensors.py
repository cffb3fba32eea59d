"""A sensor's axis, place or length is not the surveyed one; or all have errors, each its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray, Integers
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.effect import Effect, Family, Remedy, Site, Term, sigmas, whole_numbers
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.rotations import rotation_of_vector, spatial, tangents, tilted
from anser_ros.physics.sensor import SensorTable, clusters_of


@dataclass(frozen=True, kw_only=True)
class SensorAxisTerm(Term):
    """Holds one sensor's tilt, or one cluster's turn."""

    # The sensor's surveyed axis in the body's frame; empty for a cluster
    surveyed: tuple[float, ...] = ()


class SensorAxis(Effect[SensorAxisTerm]):
    """Theta is two tangent steps (rad) of a sensor, or a cluster's rotation vector (rad, body)."""

    name = 'sensor_axis'
    summary = "a sensor's axis is not the surveyed one"
    units = {'channel': '1', 'tilt_deg': 'deg', 'axis': '1', 'rotation_deg': 'deg'}
    plausible = {'tilt_deg': (0.0, 30.0)}
    remedy = Remedy.SENSORS
    typical = 0.1  # tilts are some degrees

    def candidates(self, apparatus: Apparatus) -> Sequence[SensorAxisTerm]:
        terms = [
            SensorAxisTerm(self, {'channel': channel}, np.zeros(2), surveyed=tuple(axis))
            for table in apparatus.tools
            for channel, axis in zip(table.channel.tolist(), table.axis.tolist(), strict=True)
        ]
        parts = [c for c in apparatus.clusters() if len(c) < len(terms)]  # else `BodyTurned`
        return [*terms, *(SensorAxisTerm(self, {'channels': c}, np.zeros(3)) for c in parts)]

    def columns(self, term: SensorAxisTerm, view: View) -> ComplexArray | None:
        """Return the derivative by the axis, along the tangents or across the cluster's turn."""
        if view.is_reference:
            return None
        out = view.columns(term.theta.size)
        for row in map(view.row, term.channels):
            if row is None:
                return None
            if 'channel' in term.site:
                surveyed = np.array(term.surveyed)
                pair, axis = tangents(surveyed[None])[0], self._tilted(term)
                length = np.linalg.norm(surveyed + term.theta @ pair)
                across = (pair - np.outer(pair @ axis, axis)) / length
            else:
                across = np.cross(np.eye(3), view.sensors.axis[row])
            steps = np.einsum('fij,tj->fti', view.rotation, across)
            out[:, row] = np.einsum('fik,fti->fkt', view.d_axis[:, row], steps)
        return out

    def table(self, term: SensorAxisTerm, sensors: SensorTable) -> SensorTable:
        axis = sensors.axis.copy()
        if 'channel' in term.site:
            for row in np.flatnonzero(sensors.channel == term.site['channel']):
                axis[row] = self._tilted(term)
        else:
            turn = rotation_of_vector(term.theta)
            rows = np.isin(sensors.channel, term.site['channels'])
            axis[rows] = axis[rows] @ turn.T
        return replace(sensors, axis=axis)

    def _tilted(self, term: SensorAxisTerm) -> Array:
        surveyed = np.array(term.surveyed)
        return np.asarray(tilted(surveyed[None], term.theta[None])[0])

    def record(self, term: SensorAxisTerm, covariance: Array) -> EffectRecord:
        if 'channel' not in term.site:
            turn, sigma = (np.degrees(v).tolist() for v in (term.theta, sigmas(covariance)))
            parameters = {**term.recorded_site, 'rotation_deg': turn}
            return EffectRecord(self.name, parameters, {'rotation_deg': sigma})
        tilt = float(np.linalg.norm(term.theta))
        unit = term.theta / max(tilt, 1e-12)
        sigma_deg = float(np.degrees(np.sqrt(unit @ covariance @ unit)))
        tilt_deg = float(np.degrees(np.arctan(tilt)))
        found = {'tilt_deg': tilt_deg, 'axis': self._tilted(term).tolist()}
        parameters = {**term.recorded_site, **found, 'surveyed_axis': list(term.surveyed)}
        return EffectRecord(self.name, parameters, {'tilt_deg': sigma_deg})

    def term(self, record: EffectRecord) -> SensorAxisTerm:
        if 'channels' in record.parameters:
            theta = np.radians(np.asarray(record.needed('rotation_deg'), dtype=np.float64))
            channels = whole_numbers(record.parameters['channels'])
            return SensorAxisTerm(self, {'channels': channels}, theta)
        surveyed = np.asarray(record.needed('surveyed_axis'), dtype=np.float64)
        axis = np.asarray(record.needed('axis'), dtype=np.float64)
        along = float(axis @ surveyed)
        if along <= 0:
            raise ModelFileError('model: sensor_axis turns an axis by a right angle or more')
        theta = tangents(surveyed[None])[0] @ (axis / along)
        surveyed_axis = tuple(surveyed.tolist())
        return SensorAxisTerm(self, self.site_of(record), theta, surveyed=surveyed_axis)


class PlacedElsewhere(Effect[Term]):
    """Theta is the offset of some of a body's sensors in the body's frame, m."""

    plausible = {'offset_m': (-0.03, 0.03)}
    remedy = Remedy.SENSORS
    typical = 5e-3  # offsets are some millimetres
    recorded = {'offset_m': (3, 1.0)}

    @staticmethod
    def _rows(term: Term, sensors: SensorTable) -> Booleans:
        """Which sensors (S,) are shifted: those of the site's channels, or all of its body."""
        if 'body' in term.site:
            return np.array([body == term.site['body'] for body in sensors.body])
        return np.isin(sensors.channel, term.site['channels'])

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the derivative by the centres of those sensors, along the body's axes."""
        rows = self._rows(term, view.sensors)
        if view.is_reference or not rows.any():
            return None
        out = view.columns(3)
        out[:, rows] = np.einsum('fsik,fij->fskj', view.d_position[:, rows], view.rotation)
        return out

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        rows = self._rows(term, sensors)[:, None]
        return replace(sensors, position=sensors.position + rows * term.theta)


class SensorPosition(PlacedElsewhere):
    """Shifts one sensor, or one cluster."""

    name = 'sensor_position'
    summary = 'one sensor of a body sits elsewhere than surveyed'
    units = {'channels': '1', 'offset_m': 'm'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        groups: list[tuple[int, ...]] = []
        for table in apparatus.tools:
            if len(table) > 1:
                groups += [(int(c),) for c in table.channel]
                own = {int(c) for c in table.channel}
                groups += [g for g in apparatus.clusters() if own > set(g)]
        return [Term(self, {'channels': group}, np.zeros(3)) for group in groups]


class LeverArm(PlacedElsewhere):
    """Shifts all of a body's sensors."""

    name = 'lever_arm'
    summary = "the sensors sit elsewhere in the body's frame"
    units = {'offset_m': 'm', 'body': '1'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        bodies = [table.body[0] for table in apparatus.tools if len(table)]
        return [Term(self, {'body': body}, np.zeros(3)) for body in bodies]


class BodyTurned(Effect[Term]):
    """Theta is the rotation vector (rad, body) of all of a body's sensors about its origin."""

    name = 'body_turned'
    summary = 'a body stands turned in its holder, or its axes are stated so'
    units = {'channels': '1', 'rotation_deg': 'deg'}
    remedy = Remedy.SENSORS
    typical = 0.1
    installed = is_stand = True
    recorded = {'rotation_deg': (3, 180.0 / np.pi)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        bodies = [tuple(table.channel.tolist()) for table in apparatus.tools if len(table) > 1]
        return [Term(self, {'channels': channels}, np.zeros(3)) for channels in bodies]

    def complexity(self, term: Term) -> int:
        """Return that of a registration, which goes before where a body hardly turns."""
        return 6

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        rows = np.isin(view.sensors.channel, term.site['channels'])
        if view.is_reference or not rows.any():
            return None
        out, way = view.columns(3), view.rotation @ spatial(term.theta)
        out[:, rows] = np.einsum('fsik,fij->fskj', view.d_turn[:, rows], way)
        return out

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        own = np.isin(sensors.channel, term.site['channels'])[:, None]
        turn = rotation_of_vector(term.theta)
        place, axis = (np.where(own, v @ turn.T, v) for v in (sensors.position, sensors.axis))
        return replace(sensors, position=place, axis=axis)


BODY_TURNED = BodyTurned()
SIZE_UNIT = 1e-4
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
    typical = 10.0  # coils have up to a few centimetres

    def candidates(self, apparatus: Apparatus) -> Sequence[SensorSizeTerm]:
        found = []
        for table in apparatus.tools:
            if len(table):
                lengths = dict(zip(table.channel.tolist(), table.length.tolist(), strict=True))
                site: Site = {'body': table.body[0]}
                found.append(SensorSizeTerm(self, site, np.zeros(1), surveyed=lengths))
        return found

    def columns(self, term: SensorSizeTerm, view: View) -> ComplexArray | None:
        """Return the difference between the flux of a longer coil and the coil as it is."""
        rows = np.isin(view.sensors.channel, list(term.surveyed))
        if view.is_reference or not rows.any():
            return None
        centres, axes, lengths = view.flat
        longer = np.sqrt(lengths**2 + SIZE_UNIT)
        pick = np.tile(rows, view.time.size)
        difference = np.zeros((centres.shape[0], view.omega.size), dtype=complex)
        places, ways, flux = centres[pick], axes[pick], view.dipoles.flux
        difference[pick] = flux(places, ways, longer[pick]) - flux(places, ways, lengths[pick])
        return view.along(difference)[..., None]

    def bounded(self, term: SensorSizeTerm) -> SensorSizeTerm:
        """Keep the squared length of every coil from becoming negative."""
        smallest = -min(v**2 for v in term.surveyed.values()) / SIZE_UNIT
        return term.with_theta(np.maximum(term.theta, smallest))

    def table(self, term: SensorSizeTerm, sensors: SensorTable) -> SensorTable:
        length = sensors.length.copy()
        for row, channel in enumerate(sensors.channel.tolist()):
            if channel in term.surveyed:
                squared = term.surveyed[channel] ** 2 + SIZE_UNIT * term.theta[0]
                length[row] = np.sqrt(max(squared, 0.0))
        return replace(sensors, length=length)

    def record(self, term: SensorSizeTerm, covariance: Array) -> EffectRecord:
        base = float(np.mean(np.square(list(term.surveyed.values()))))
        length = float(np.sqrt(max(base + SIZE_UNIT * term.theta[0], 0.0)))
        sigma = SIZE_UNIT * float(np.sqrt(covariance[0, 0])) / (2 * max(length, 1e-4))
        surveyed = {'surveyed_length_m': list(term.surveyed.values())}
        parameters = {'length_m': length, 'channels': list(term.surveyed), **surveyed}
        return EffectRecord(self.name, parameters, {'length_m': sigma})

    def term(self, record: EffectRecord) -> SensorSizeTerm:
        channels = self.site_of(record)['channels']
        surveyed = record.parameters.get('surveyed_length_m') or [0.0] * len(channels)
        base = float(np.mean(np.square(surveyed)))
        theta = (float(record.needed('length_m')) ** 2 - base) / SIZE_UNIT
        lengths = dict(zip(channels, (float(v) for v in surveyed), strict=True))
        return SensorSizeTerm(self, {}, np.array([theta]), surveyed=lengths)


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

    def of(self, channels: AnyArray) -> Array:
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
        channels = self.site_of(record)['channels']
        values = np.asarray(record.needed('values'), dtype=np.float64)
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

    def channel_matrix(self, term: SpreadTerm, channels: Integers) -> ComplexArray | None:
        parts = term.of(channels)
        return np.asarray(np.eye(channels.size) + np.diag(parts[:, 0] + 1j * parts[:, 1]))

    def gain_changes(self, term: SpreadTerm, sensors: SensorTable) -> Array | None:
        """Return a change for each place; sensors at one place have their gains in common.

        One session cannot show how far a gain changes until the next: the differences among
        sensors of a kind give the natural size of such a change.
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


class SensorDelaySpread(SensorSpread):
    """Values are delays (s) about the mean tone, whose phases are those of the gains."""

    name = 'sensor_delay_spread'
    summary = "every channel's phase depends on the tone in its own way"
    units = {'spread': 's', 'channels': '1', 'values': 's'}
    remedy = Remedy.FLUX
    parts = ('delay',)
    faultless = (0.0,)

    def response(self, term: SpreadTerm, channels: Integers, omega: Array) -> ComplexArray | None:
        return np.asarray(np.exp(-1j * term.of(channels) * (omega - omega.mean())))


class SensorAxisSpread(SensorSpread):
    """Values are the tilts (rad) of each axis along its two tangents (`physics.rotations`)."""

    name = 'sensor_axis_spread'
    summary = "every sensor's axis is a little off"
    units = {'spread': 'rad', 'channels': '1', 'values': 'rad'}
    remedy = Remedy.SENSORS
    parts = ('first tangent', 'second tangent')
    faultless = (0.0, 0.0)

    def table(self, term: SpreadTerm, sensors: SensorTable) -> SensorTable:
        return replace(sensors, axis=tilted(sensors.axis, term.of(sensors.channel)))


class SensorPlaceSpread(SensorSpread):
    """Values are the shifts (m) of each sensor in its body's frame."""

    name = 'sensor_place_spread'
    summary = 'every sensor sits a little off its surveyed place'
    units = {'spread': 'm', 'channels': '1', 'values': 'm'}
    remedy = Remedy.SENSORS
    parts = ('x', 'y', 'z')
    faultless = (0.0, 0.0, 0.0)

    def table(self, term: SpreadTerm, sensors: SensorTable) -> SensorTable:
        return replace(sensors, position=sensors.position + term.of(sensors.channel))


class SensorPickupSpread(SensorSpread):
    """Values are the real and imaginary part of each emitter's phasor in each channel, T."""

    name = 'sensor_pickup_spread'
    summary = 'a constant phasor of its own is added to every channel'
    units = {'spread': 'T', 'channels': '1', 'values': 'T'}
    plausible = {'spread': (0.0, 1.0)}
    remedy = Remedy.FLUX

    def offset(self, term: SpreadTerm, channels: Integers, emitters: int) -> ComplexArray | None:
        parts = term.of(channels)
        return np.asarray(parts[:, 0::2] + 1j * parts[:, 1::2])


EFFECTS = (
    SensorAxis(), SensorPosition(), LeverArm(), BODY_TURNED, SensorSize(),
    SensorGainSpread(), SensorDelaySpread(), SensorAxisSpread(), SensorPlaceSpread(),
    SensorPickupSpread(),
)  # fmt: skip
