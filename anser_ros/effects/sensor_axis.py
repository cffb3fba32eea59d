"""A sensor's axis, or a whole triaxial cluster's frame, is not the surveyed one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Site,
    Term,
    needed,
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
    units = {
        'channel': '1',
        'tilt_deg': 'deg',
        'axis': '1',
        'rotation_deg': 'deg',
    }
    plausible = {'tilt_deg': (0.0, 30.0)}
    remedy = Remedy.SENSORS

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

    def prior(self, term: SensorAxisTerm) -> Array:
        """Return a prior spread of 0.1 rad: tilts are some degrees."""
        return np.full(term.theta.size, 0.1)

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
        rows = [view.row(c) for c in term.site['channels']]
        if any(row is None for row in rows):
            return None
        for row in rows:
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
            return EffectRecord(
                self.name,
                {
                    'channels': list(term.site['channels']),
                    'rotation_deg': np.degrees(term.theta).tolist(),
                },
                {'rotation_deg': np.degrees(sigmas(covariance)).tolist()},
            )
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
            return SensorAxisTerm(self, {'channels': whole_numbers(record, 'channels')}, theta)
        surveyed = np.asarray(needed(record, 'surveyed_axis'), dtype=np.float64)
        axis = np.asarray(needed(record, 'axis'), dtype=np.float64)
        along = float(axis @ surveyed)
        if along <= 0:
            raise ModelFileError('model: sensor_axis turns an axis by a right angle or more')
        theta = tangents(surveyed[None])[0] @ (axis / along)
        site: Site = {'channel': int(needed(record, 'channel'))}
        return SensorAxisTerm(self, site, theta, surveyed=tuple(surveyed.tolist()))


EFFECTS = (SensorAxis(),)
