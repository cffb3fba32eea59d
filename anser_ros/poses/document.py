"""Writes the documents that a diagnosis of poses leaves, as `docs/interfaces.md` promises them."""

from typing import Any

import numpy as np

from anser_ros.diagnosis.schema import SCHEMA
from anser_ros.field.plain_data import plain
from anser_ros.poses.diagnosis import PoseDiagnosis

MODEL_SCHEMA = 'anser_pose_model/1'
"""Name of the layout of a model of poses."""


def to_document(found: PoseDiagnosis) -> dict[str, Any]:
    """Return the diagnosis as plain data; figures of fluxes are null."""
    before, after = found.before, found.after
    document: dict[str, Any] = {
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': None, 'flux_rms_after_t': None, 'flux_rms_floor_t': None,
            'position_rmse_before_m': before.position_m,
            'position_rmse_after_m': after.position_m,
            'orientation_rmse_before_rad': before.orientation_rad,
            'orientation_rmse_after_rad': after.orientation_rad,
            'position_rmse_registration_only_m': found.registered.position_m,
            'position_floor_m': found.floor_m,
        },
        'sensors': {
            name: {
                'position_rmse_registration_only_m': found.registered.by_sensor[name][0],
                'position_rmse_before_m': before.by_sensor[name][0],
                'position_rmse_after_m': after.by_sensor[name][0],
                'orientation_rmse_before_rad': before.by_sensor[name][1],
                'orientation_rmse_after_rad': after.by_sensor[name][1],
            }
            for name in after.by_sensor
        },
        'effects': [
            {
                'name': record.name, 'parameters': plain(record.parameters),
                'uncertainty': plain(record.uncertainty), 'evidence': plain(record.evidence),
                'flux_rms_without_t': None,
            }
            for record in found.records
        ],
        'unexplained': {
            'fraction': found.unexplained, 'depends_on': list(found.depends_on),
        },
        'left_out': list(found.left_out),
        'knows_levers': found.knows_levers,
        'refused': [{'candidate': label, 'why': why} for label, why in found.refused],
    }  # fmt: skip
    return dict(finite(document))


def to_model(found: PoseDiagnosis) -> dict[str, Any]:
    """Return what a corrector needs: the frames and the effects, and where they were learnt."""
    document = to_document(found)
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
        'support': {
            'low_m': low.tolist(),
            'high_m': high.tolist(),
            'first_ns': first,
            'last_ns': last,
        },
        'effects': [
            {key: effect[key] for key in ('name', 'parameters', 'uncertainty')}
            for effect in document['effects']
        ],
    }


def finite(value: Any) -> Any:
    """Return plain data with None where a number is not finite, which JSON has no word for."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
