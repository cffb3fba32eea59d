"""Sensors sit elsewhere in the body than the setup says: one, a cluster, or all of them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    recorded_site,
    sigmas,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable


class PlacedElsewhere(Effect[Term]):
    """Theta is the offset of some of a body's sensors in the body's frame, m."""

    plausible = {'offset_m': (-0.03, 0.03)}
    remedy = Remedy.SENSORS

    def rows(self, term: Term, sensors: SensorTable) -> NDArray[np.bool_]:
        """Return which sensors (S,) are shifted."""
        raise NotImplementedError

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 5 mm: offsets are some millimetres."""
        return np.full(3, 5e-3)

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

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the site and the offset."""
        return EffectRecord(
            self.name,
            {**recorded_site(term), 'offset_m': term.theta.tolist()},
            {'offset_m': sigmas(covariance).tolist()},
        )


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

    def term(self, record: EffectRecord) -> Term:
        """Read the channels and their offset, m, from a record."""
        offset = np.asarray(needed(record, 'offset_m'), dtype=np.float64)
        return Term(self, {'channels': whole_numbers(record, 'channels')}, offset)


class LeverArm(PlacedElsewhere):
    """Shifts all of a body's sensors."""

    name = 'lever_arm'
    summary = "the sensors sit elsewhere in the body's frame"
    units = {'offset_m': 'm', 'body': '1'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body that has sensors."""
        return [
            Term(self, {'body': table.body[0]}, np.zeros(3))
            for table in apparatus.tools
            if len(table)
        ]

    def rows(self, term: Term, sensors: SensorTable) -> NDArray[np.bool_]:
        """Return the sensors of the site's body."""
        return np.array([body == term.site['body'] for body in sensors.body])

    def term(self, record: EffectRecord) -> Term:
        """Read the body and its offset, m, from a record."""
        offset = np.asarray(needed(record, 'offset_m'), dtype=np.float64)
        return Term(self, {'body': str(needed(record, 'body'))}, offset)


EFFECTS = (
    SensorPosition(),
    LeverArm(),
)
