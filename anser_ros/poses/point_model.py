"""Writes an error map of points as a model of poses, which the corrector applies like others."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.calibration.error_map import ErrorMap
from anser_ros.poses.document import MODEL_SCHEMA
from anser_ros.poses.effect import Role
from anser_ros.poses.registry import effect_with
from anser_ros.poses.smooth_map import SMOOTH


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
