"""What correcting a tracked pose costs: clock, frames and a quadratic map with its covariance."""

from __future__ import annotations

import time

import harness
import numpy as np

from anser_ros.apps.poses.corrector import MODEL_SCHEMA, PoseCorrector
from anser_ros.apps.poses.effects.field_distortion import UNIT_M, FieldDistortion, monomials
from anser_ros.field.model import EffectRecord

SENSOR = 'tip'
DEGREE = 2
POSES, ROUNDS = 200, 20
TARGET_MS = 0.3


def corrector() -> PoseCorrector:
    """Return the corrector of a model with an offset of the clocks and a map of one sensor."""
    count = monomials(np.zeros((1, 3)), np.zeros(3), 1.0, DEGREE, 0).shape[1]
    bend = EffectRecord(
        FieldDistortion.name,
        {
            'sensor': SENSOR, 'degree': DEGREE, 'kind': 'quadratic', 'centre_m': [0.0, 0.0, -0.3],
            'size_m': 60 * UNIT_M, 'coefficients_mm': np.linspace(-1, 1, 3 * count).tolist(),
        },
        {'coefficients_mm': np.full(3 * count, 0.1).tolist()},
    )  # fmt: skip
    late = EffectRecord('time_offset', {'offset_s': 0.03}, {'offset_s': 1e-4})
    mount = EffectRecord('hand_eye', {'sensor': SENSOR, 'lever_arm_m': [0.0, 0.04, 0.0]}, {})
    return PoseCorrector(
        {
            'schema': MODEL_SCHEMA,
            'held_out_position_rmse_m': 1e-3,
            'held_out_orientation_rmse_rad': 5e-3,
            'support': {'low_m': [-0.1, -0.1, -0.4], 'high_m': [0.1, 0.1, -0.2]},
            'effects': [
                {'name': r.name, 'parameters': r.parameters, 'uncertainty': r.uncertainty}
                for r in (mount, late, bend)
            ],
        }
    )


def rows() -> list[harness.Row]:
    """Return the rows of the benchmark table."""
    one, turn = corrector(), np.array([0.0, 0.0, 0.0, 1.0])
    places = np.random.default_rng(0).uniform(-0.08, 0.08, (POSES, 3)) + [0.0, 0.0, -0.3]
    spent_ms = []
    for _ in range(ROUNDS):
        start = time.thread_time()
        for place in places:
            one.correct(SENSOR, 1, place, turn)
        spent_ms.append(1e3 * (time.thread_time() - start) / POSES)
    name = 'a tracked pose corrected, quadratic map with covariance'
    return [harness.row(name, float(np.median(spent_ms)), 'ms', target=TARGET_MS)]
