"""The sensors sit elsewhere in the body's frame than the setup says."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import needed
from anser_ros.effects.sensor_position import PlacedElsewhere
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable


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


EFFECTS = (LeverArm(),)
