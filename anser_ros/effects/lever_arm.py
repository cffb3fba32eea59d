"""The sensors sit elsewhere in the body's frame than the setup says."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed, sigmas
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable


class LeverArm(Effect[Term]):
    """Theta is the offset of all of a body's sensors in the body's frame, m."""

    name = 'lever_arm'
    summary = "the sensors sit elsewhere in the body's frame"
    units: ClassVar[Mapping[str, str]] = {'offset_m': 'm', 'body': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'offset_m': (-0.03, 0.03)}
    remedy = Remedy.SENSORS

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body that has sensors."""
        return [
            Term(self, {'body': table.body[0]}, np.zeros(3))
            for table in apparatus.tools
            if len(table)
        ]

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 5 mm: offsets are some millimetres."""
        return np.full(3, 5e-3)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the derivative by the centres, along the body's axes."""
        if view.is_reference or view.sensors.body[0] != term.site['body']:
            return None
        return np.asarray(np.einsum('fsik,fij->fskj', view.d_position, view.rotation))

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        """Return the table with the body's sensors shifted by the offset, m."""
        rows = np.array([body == term.site['body'] for body in sensors.body])
        return sensors.with_geometry(
            position=sensors.position + rows[:, None] * term.theta[None, :]
        )

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the offset and the body."""
        return EffectRecord(
            self.name,
            {'offset_m': term.theta.tolist(), 'body': term.site['body']},
            {'offset_m': sigmas(covariance).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the body and its offset, m, from a record."""
        offset = np.asarray(needed(record, 'offset_m'), dtype=np.float64)
        return Term(self, {'body': str(needed(record, 'body'))}, offset)


EFFECTS = (LeverArm(),)
