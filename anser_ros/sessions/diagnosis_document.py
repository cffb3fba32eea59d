"""Writes the document that a diagnosis leaves, as `docs/interfaces.md` promises it."""

from typing import Any

from anser_ros.diagnosis.schema import SCHEMA
from anser_ros.field.model import EffectRecord
from anser_ros.field.plain_data import plain
from anser_ros.sessions.diagnosis import SessionDiagnosis

DEPENDENCIES = (
    'time', 'position', 'orientation', 'speed', 'emitter', 'channel', 'amplitude', 'frequency',
)  # fmt: skip
"""Variables on which a remainder may depend in words; other tests are for the report only."""
MODEL_FILE_ONLY = ('groups', 'knots_s', 'course', 'couplings_m3')
"""Parameters that only a program needs: lists of hundreds of numbers. They are left out here and
stand in the model file."""


def to_document(result: SessionDiagnosis) -> dict[str, Any]:
    """Return what was found as plain data."""
    found = result.diagnosis
    return {
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': found.flux_rms_before_t,
            'flux_rms_after_t': found.flux_rms_after_t,
            'flux_rms_floor_t': found.flux_rms_floor_t,
            'position_rmse_before_m': result.before.position_rmse_m,
            'position_rmse_after_m': result.after.position_rmse_m,
            'orientation_rmse_before_rad': result.before.orientation_rmse_rad,
            'orientation_rmse_after_rad': result.after.orientation_rmse_rad,
        },
        'effects': [
            effect_figures(finding.record, finding.flux_rms_without_t)
            for finding in found.findings
        ],
        'unexplained': {
            'fraction': found.unexplained,
            'depends_on': [name for name in found.depends_on if name in DEPENDENCIES],
        },
    }


def effect_figures(record: EffectRecord, without_t: float) -> dict[str, Any]:
    """Return an effect as plain data; ``without_t``: held-out residual with all but it, T."""
    short = {key: value for key, value in record.parameters.items() if key not in MODEL_FILE_ONLY}
    return {
        'name': record.name,
        'parameters': plain(short),
        'uncertainty': plain(dict(record.uncertainty)),
        'evidence': plain(dict(record.evidence)),
        'flux_rms_without_t': without_t,
    }
