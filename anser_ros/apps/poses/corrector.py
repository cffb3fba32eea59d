"""Writes models of poses, of a diagnosis or of points, and applies them to poses one by one."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.convention import PoseReading
from anser_ros.apps.poses.diagnosis import PoseDiagnosis
from anser_ros.apps.poses.effect import SMOOTH, PoseMap, Role, effect_of_record, effect_with
from anser_ros.apps.poses.hand_eye import PoseClock
from anser_ros.apps.poses.problem import noise_table
from anser_ros.apps.poses.sequence import FARTHEST, NO_TURN, PoseSequence, PoseSession
from anser_ros.arrays import Array
from anser_ros.calibration.error_map import ErrorMap
from anser_ros.diagnosis.diagnose import SCHEMA
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord, plain

MOUNT = effect_with(Role.MOUNT).name
MODEL_SCHEMA = 'anser_pose_model/1'
"""Name of the layout of a model of poses."""


def to_document(found: PoseDiagnosis) -> dict[str, Any]:
    """Return the diagnosis as plain data; figures of fluxes are null."""
    registered, before, after = found.registered, found.before, found.after
    return as_document({
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': None, 'flux_rms_after_t': None, 'flux_rms_floor_t': None,
            **_rms(before.position_m, before.orientation_rad, after.position_m,
                   after.orientation_rad),
            'position_rmse_registration_only_m': registered.position_m,
            'position_rmse_outside_episodes_m': found.outside_m,
            'position_floor_m': found.floor_m,
        },
        'sensors': {
            name: {
                'position_rmse_registration_only_m': registered.by_sensor[name][0],
                **_rms(*before.by_sensor[name], *after.by_sensor[name]),
            }
            for name in after.by_sensor
        },
        'noise': noise_table(found.fit.state),
        'effects': [{**vars(record), 'flux_rms_without_t': None} for record in found.records],
        'unexplained': {'fraction': found.unexplained, 'depends_on': found.depends_on},
        'left_out': found.left_out,
        'knows_levers': found.knows_levers,
        'refused': [{'candidate': label, 'why': why} for label, why in found.refused],
    })  # fmt: skip


def _rms(m_before: float, rad_before: float, m_after: float, rad_after: float) -> dict[str, float]:
    return {
        'position_rmse_before_m': m_before,
        'position_rmse_after_m': m_after,
        'orientation_rmse_before_rad': rad_before,
        'orientation_rmse_after_rad': rad_after,
    }


def to_model(found: PoseDiagnosis, before: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what a corrector needs: the frames and the effects, and where they were learnt.

    ``before``: the model by which the session had been corrected; its effects go on.
    """
    document = to_document(found)
    known = [e for e in (before or {'effects': []})['effects'] if e['name'] != MOUNT]
    places = np.concatenate([s.position for s in found.session.sensors.values()])
    low, high = np.percentile(places, [1, 99], axis=0)
    setting = found.fit.state.problem.setting
    first, last = (
        found.session.start_ns + round(1e9 * (setting.start + share * setting.duration))
        for share in (0, 1)
    )
    return {
        'schema': MODEL_SCHEMA,
        'provenance': {'session': found.session.path},
        'held_out_position_rmse_m': document['held_out']['position_rmse_after_m'],
        'held_out_orientation_rmse_rad': document['held_out']['orientation_rmse_after_rad'],
        'support': {'low_m': low.tolist(), 'high_m': high.tolist(),
                    'first_ns': first, 'last_ns': last},
        'effects': [
            {key: effect[key] for key in ('name', 'parameters', 'uncertainty')}
            for effect in [*document['effects'], *known]
        ],
    }  # fmt: skip


def as_document(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain data with None where a number is not finite, which JSON has no word for."""
    return dict(_finite(plain(dict(values))))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def to_point_model(found: ErrorMap, sensor: str, source: str) -> dict[str, Any]:
    """Return what a corrector needs of an error map; a map that is not confirmed corrects nothing.

    ``sensor``: whose poses are to be corrected; ``source``: where the points are from.
    """
    turn = Rotation.from_matrix(found.rotation).as_rotvec(degrees=True)
    frames = {
        'sensor': sensor,
        'registration_rotation_deg': turn.tolist(),
        'registration_translation_m': found.translation.tolist(),
    }
    effects = [{'name': effect_with(Role.MOUNT).name, 'parameters': frames, 'uncertainty': {}}]
    if found.is_confirmed:
        shape, moved = found.shape, found.correction(found.places)
        parameters = {
            'sensor': sensor, 'kind': SMOOTH, 'trend': shape.trend, 'length_m': shape.length_m,
            'noise': shape.noise, 'rms_m': float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
            'places_m': found.places.tolist(), 'errors_m': found.errors.tolist(),
        }  # fmt: skip
        effects.append(
            {'name': effect_with(Role.MAP).name, 'parameters': parameters, 'uncertainty': {}}
        )
    best = found.after if found.is_confirmed else found.before
    return {
        'schema': MODEL_SCHEMA,
        'provenance': {'points': source},
        'held_out_position_rmse_m': best.whole,
        'held_out_orientation_rmse_rad': float(np.pi),  # points say nothing about it
        'support': {
            'low_m': found.places.min(axis=0).tolist(),
            'high_m': found.places.max(axis=0).tolist(),
        },
        'effects': effects,
    }


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

    ``document``: as `anser_ros.apps.poses.corrector.to_model` makes it. Raises `ModelFileError`
    when it is no pose model, or a record lacks a parameter.
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
            shift, spread = mapping(sensor, inside, Rotation.from_quat(turn).as_matrix())
            variance += spread
            place = place + shift
        covariance = np.diag(np.repeat([variance, self._turn**2], 3))
        state = OK if away == 0.0 else OUTSIDE
        late_ns = self._clock.late_ns(sensor, stamp_ns)
        return CorrectedPose(state, stamp_ns - late_ns, place, turn, covariance)


def corrected(session: PoseSession, document: Mapping[str, Any]) -> PoseSession:
    """Return a session as a model (`PoseCorrector`) corrects it, without sensors unknown to it.

    Raises `ModelFileError` when it knows none, or is no model of poses.
    """
    corrector, sensors, states = PoseCorrector(document), {}, []
    for name in (n for n in session.sensors if n in corrector.sensors):
        poses = session.sensors[name]
        stamps = session.start_ns + np.round(1e9 * poses.time).astype(np.int64)
        rows = zip(stamps.tolist(), poses.position, poses.quaternion, strict=True)
        done = [corrector.correct(name, *row) for row in rows]
        states += [one.state for one in done]
        time = 1e-9 * np.array([one.stamp_ns - session.start_ns for one in done])
        place, turn = (np.array([getattr(one, k) for one in done]).reshape(-1, n)
                       for k, n in (('position', 3), ('quaternion', 4)))  # fmt: skip
        sensors[name] = replace(poses, time=time, position=place, quaternion=turn)
    if not sensors:
        known = ', '.join(sorted(corrector.sensors))
        raise ModelFileError(f'the model knows {known}, the session {", ".join(session.sensors)}')
    words = [session.lost] if session.lost else []
    if outside := states.count(OUTSIDE):
        words.append(
            f'{outside} of {len(states)} poses lie outside the places where the model was learnt'
        )
    return replace(session, sensors=sensors, lost='; '.join(words))
