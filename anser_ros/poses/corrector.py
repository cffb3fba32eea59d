"""Applies a pose model to poses one by one: the same offline and in the live node."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.poses.clock_records import PoseClock
from anser_ros.poses.convention import PoseReading
from anser_ros.poses.document import MODEL_SCHEMA
from anser_ros.poses.effect import PoseMap, Role
from anser_ros.poses.registry import effect_of_record
from anser_ros.poses.sequence import FARTHEST, NO_TURN, PoseSequence

Array = NDArray[np.float64]

OK, OUTSIDE, NO_POSE, UNKNOWN = 'ok', 'outside_support', 'no_pose', 'unknown_sensor'
"""States of a corrected pose: what is published is in one of the first two."""
GROWTH = 0.1
"""How fast a pose's error may grow outside the places where the model was learnt, m a metre: the
strain that a distortion may have."""


@dataclass(frozen=True)
class CorrectedPose:
    """Holds a pose without what the model knows of its errors."""

    # `OK`, or why not: outside the places where the model was learnt, no pose, no such sensor.
    state: str
    stamp_ns: int  # on the reference's clock
    position: Array  # (3,), m, tracker's frame
    quaternion: Array  # (4,), x y z w
    covariance: Array  # (6, 6), of position (m) and turn (rad) along the tracker's axes


class PoseCorrector:
    """Applies a pose model's offsets, conventions and maps.

    ``document``: as `anser_ros.poses.document.to_model` makes it.

    Raises `ModelFileError` when it is no pose model, or a record lacks a parameter.
    """

    def __init__(self, document: Mapping[str, Any]) -> None:
        if not isinstance(document, Mapping) or document.get('schema') != MODEL_SCHEMA:
            raise ModelFileError(f'not a model of poses: the schema must be {MODEL_SCHEMA}')
        try:
            support = document['support']
            self._low = np.asarray(support['low_m'], dtype=np.float64)
            self._high = np.asarray(support['high_m'], dtype=np.float64)
            self._sigma = float(document['held_out_position_rmse_m']) / np.sqrt(3)
            self._turn = float(document['held_out_orientation_rmse_rad']) / np.sqrt(3)
            records = [
                EffectRecord(e['name'], e['parameters'], e.get('uncertainty') or {})
                for e in document['effects']
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f'model of poses: {error!r} is missing or not a number') from None
        self.sensors: set[str] = set()
        self._clock = PoseClock(records, support)
        self._maps: list[PoseMap] = []
        self._reading = PoseReading()
        for record in records:
            effect = effect_of_record(record)
            if effect.role is Role.MOUNT:
                self.sensors.add(str(record.parameters['sensor']))
            elif effect.role is Role.READING and record.parameters['stream'] == 'tracked':
                self._reading = PoseReading(**dict(record.parameters))
            elif mapping := effect.mapping(record):
                self._maps.append(mapping)

    def correct(
        self, sensor: str, stamp_ns: int, position: Array, quaternion: Array
    ) -> CorrectedPose:
        """Return the pose of a sensor as it is, with its covariance and state.

        ``stamp_ns``: on the tracker's clock; ``position`` (3,): as the tracker reports it; markers
        for no pose give the state `NO_POSE`; ``quaternion`` (4,).
        """
        empty = CorrectedPose(NO_POSE, stamp_ns, position, quaternion, np.full((6, 6), np.nan))
        if sensor not in self.sensors:
            return CorrectedPose(UNKNOWN, stamp_ns, position, quaternion, empty.covariance)
        norm = float(np.sqrt(quaternion @ quaternion))
        whole = np.isfinite(position).all() and np.abs(position).max() < FARTHEST
        if not whole or not NO_TURN < norm < FARTHEST:
            return empty
        place, turn = position, quaternion / norm
        if not self._reading.is_plain:
            one = PoseSequence('', np.zeros(1), place[None], turn[None], np.zeros(0))
            read = self._reading.of_sequence(one)
            place, turn = read.position[0], read.quaternion[0]
        outside = np.maximum(np.maximum(self._low - place, place - self._high), 0.0)
        away = float(np.sqrt(outside @ outside))
        inside = np.clip(place, self._low, self._high)
        variance = self._sigma**2 + (GROWTH * away) ** 2
        for mapping in self._maps:
            # Outside it is held at the border: a polynomial knows nothing beyond it.
            shift, spread = mapping(sensor, inside)
            variance += spread
            place = place + shift
        covariance = np.diag(np.repeat([variance, self._turn**2], 3))
        state = OK if away == 0.0 else OUTSIDE
        late_ns = self._clock.late_ns(sensor, stamp_ns)
        return CorrectedPose(state, stamp_ns - late_ns, place, turn, covariance)
