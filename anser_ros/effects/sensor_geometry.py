"""A sensor's axis, place or length is not the surveyed one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Site,
    Term,
    needed,
    recorded_site,
    sigmas,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.rotations import tangents, tilted
from anser_ros.physics.sensor import SensorTable


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
        """Try every single tool sensor, and every cluster as a whole."""
        axes = {
            int(c): tuple(float(v) for v in a)
            for table in apparatus.tools
            for c, a in zip(table.channel, table.axis, strict=True)
        }
        terms = [
            SensorAxisTerm(self, {'channel': c}, np.zeros(2), surveyed=axes[c])
            for c in apparatus.tool_channels
        ]
        for cluster in apparatus.clusters():
            if len(apparatus.tool_channels) > len(cluster) and len(cluster) > 1:
                terms.append(SensorAxisTerm(self, {'channels': cluster}, np.zeros(3)))
        return terms

    def columns(self, term: SensorAxisTerm, view: View) -> ComplexArray | None:
        """Return the derivative by the axis, along the tangents or across the cluster's turn."""
        if view.is_reference:
            return None
        out = view.columns(term.theta.size)
        if 'channel' in term.site:
            row = view.row(term.site['channel'])
            if row is None:
                return None
            surveyed = np.array(term.surveyed)
            pair, axis = tangents(surveyed[None])[0], self._tilted(term)
            length = np.linalg.norm(surveyed + term.theta @ pair)
            across = (pair - np.outer(pair @ axis, axis)) / length
            steps = np.einsum('fij,tj->fti', view.rotation, across)
            out[:, row] = np.einsum('fik,fti->fkt', view.d_axis[:, row], steps)
            return out
        for row in map(view.row, term.site['channels']):
            if row is None:
                return None
            axis = view.sensors.axis[row]
            steps = np.einsum('fij,tj->fti', view.rotation, np.cross(np.eye(3), axis))
            out[:, row] = np.einsum('fik,fti->fkt', view.d_axis[:, row], steps)
        return out

    def table(self, term: SensorAxisTerm, sensors: SensorTable) -> SensorTable:
        """Return the table with the sensors' true axes."""
        axis = sensors.axis.copy()
        if 'channel' in term.site:
            for row in np.flatnonzero(sensors.channel == term.site['channel']):
                axis[row] = self._tilted(term)
        else:
            turn = Rotation.from_rotvec(term.theta).as_matrix()
            rows = np.isin(sensors.channel, term.site['channels'])
            axis[rows] = axis[rows] @ turn.T
        return sensors.with_geometry(axis=axis)

    def _tilted(self, term: SensorAxisTerm) -> Array:
        surveyed = np.array(term.surveyed)
        return np.asarray(tilted(surveyed[None], term.theta[None])[0])

    def record(self, term: SensorAxisTerm, covariance: Array) -> EffectRecord:
        """Record tilt and true axis, or the cluster's rotation."""
        if 'channel' not in term.site:
            turn, sigma = (np.degrees(v).tolist() for v in (term.theta, sigmas(covariance)))
            parameters = {**recorded_site(term), 'rotation_deg': turn}
            return EffectRecord(self.name, parameters, {'rotation_deg': sigma})
        tilt = float(np.linalg.norm(term.theta))
        unit = term.theta / max(tilt, 1e-12)
        return EffectRecord(
            self.name,
            {
                'channel': term.site['channel'],
                'tilt_deg': float(np.degrees(np.arctan(tilt))),
                'axis': self._tilted(term).tolist(),
                'surveyed_axis': list(term.surveyed),
            },
            {'tilt_deg': float(np.degrees(np.sqrt(unit @ covariance @ unit)))},
        )

    def term(self, record: EffectRecord) -> SensorAxisTerm:
        """Read a sensor's true axis, or the cluster's rotation, from a record."""
        if 'channels' in record.parameters:
            theta = np.radians(np.asarray(needed(record, 'rotation_deg'), dtype=np.float64))
            channels = whole_numbers(record.parameters['channels'])
            return SensorAxisTerm(self, {'channels': channels}, theta)
        surveyed = np.asarray(needed(record, 'surveyed_axis'), dtype=np.float64)
        axis = np.asarray(needed(record, 'axis'), dtype=np.float64)
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

    def rows(self, term: Term, sensors: SensorTable) -> NDArray[np.bool_]:
        """Return which sensors (S,) are shifted."""
        raise NotImplementedError

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the derivative by the centres of those sensors, along the body's axes."""
        rows = self.rows(term, view.sensors)
        if view.is_reference or not rows.any():
            return None
        out = view.columns(3)
        out[:, rows] = np.einsum('fsik,fij->fskj', view.d_position[:, rows], view.rotation)
        return out

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        """Return the table with those sensors shifted by the offset, m."""
        rows = self.rows(term, sensors)[:, None]
        return sensors.with_geometry(position=sensors.position + rows * term.theta)


class SensorPosition(PlacedElsewhere):
    """Shifts one sensor, or one cluster."""

    name = 'sensor_position'
    summary = 'one sensor of a body sits elsewhere than surveyed'
    units = {'channels': '1', 'offset_m': 'm'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try single sensors and clusters of bodies that carry more than those."""
        groups: list[tuple[int, ...]] = []
        for table in apparatus.tools:
            if len(table) > 1:
                groups += [(int(c),) for c in table.channel]
                own = {int(c) for c in table.channel}
                groups += [g for g in apparatus.clusters() if own > set(g)]
        return [Term(self, {'channels': group}, np.zeros(3)) for group in groups]

    def rows(self, term: Term, sensors: SensorTable) -> NDArray[np.bool_]:
        """Return the sensors of the site's channels."""
        return np.isin(sensors.channel, term.site['channels'])


class LeverArm(PlacedElsewhere):
    """Shifts all of a body's sensors."""

    name = 'lever_arm'
    summary = "the sensors sit elsewhere in the body's frame"
    units = {'offset_m': 'm', 'body': '1'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body that has sensors."""
        bodies = [table.body[0] for table in apparatus.tools if len(table)]
        return [Term(self, {'body': body}, np.zeros(3)) for body in bodies]

    def rows(self, term: Term, sensors: SensorTable) -> NDArray[np.bool_]:
        """Return the sensors of the site's body."""
        return np.array([body == term.site['body'] for body in sensors.body])


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
    typical = 10.0  # coils have up to a few centimetres

    def candidates(self, apparatus: Apparatus) -> Sequence[SensorSizeTerm]:
        """Return a candidate for all coils of each body that has sensors."""
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
        longer = np.sqrt(lengths**2 + UNIT)
        pick = np.tile(rows, view.time.size)
        difference = np.zeros((centres.shape[0], view.omega.size), dtype=complex)
        places, ways, flux = centres[pick], axes[pick], view.dipoles.flux
        difference[pick] = flux(places, ways, longer[pick]) - flux(places, ways, lengths[pick])
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
        parameters = {
            'length_m': length,
            'channels': list(term.surveyed),
            'surveyed_length_m': list(term.surveyed.values()),
        }
        return EffectRecord(self.name, parameters, {'length_m': sigma})

    def term(self, record: EffectRecord) -> SensorSizeTerm:
        """Read the coils' length from a record."""
        channels = self.site_of(record)['channels']
        surveyed = record.parameters.get('surveyed_length_m') or [0.0] * len(channels)
        base = float(np.mean(np.square(surveyed)))
        theta = (float(needed(record, 'length_m')) ** 2 - base) / UNIT
        lengths = dict(zip(channels, (float(v) for v in surveyed), strict=True))
        return SensorSizeTerm(self, {}, np.array([theta]), surveyed=lengths)


EFFECTS = SensorAxis(), SensorPosition(), LeverArm(), SensorSize()
